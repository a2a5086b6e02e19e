// Blending of splats and its gradient, one tile at a time; a block of 4 x 4 pixels is one SIMD vector.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

// Offsets of a block's pixels from its first pixel.
inline Floats pixels_across() {
    static const float kAcross[kLanes] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
    return load(kAcross);
}
inline Floats pixels_down() {
    static const float kDown[kLanes] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
    return load(kDown);
}

// A stored splat, broadcast to all lanes.
inline Splat<Floats> splat_at(const float* s) {
    return {Floats(s[0]),
            Floats(s[1]),
            Floats(s[2]),
            Floats(s[3]),
            Floats(s[4]),
            Floats(s[5]),
            {Floats(s[6]), Floats(s[7]), Floats(s[8])},
            Floats(s[9]),
            Floats(s[10]),
            Floats(s[11]),
            {Floats(s[12]), Floats(s[13]), Floats(s[14])}};
}

// The position of a block of a tile, and a bit for each of its pixels inside the image.
struct BlockArea {
    int x, y;
    unsigned inside;
};
inline BlockArea block_area(const Frame& frame, int tile, int block) {
    const int x = tile % frame.tiles_across * kTile + block % kBlocksAcross * kBlock;
    const int y = tile / frame.tiles_across * kTile + block / kBlocksAcross * kBlock;
    unsigned inside = 0;
    for (int j = 0; j < kBlock; ++j)
        for (int i = 0; i < kBlock; ++i)
            if (x + i < frame.pinhole.width && y + j < frame.pinhole.height) inside |= 1u << (kBlock * j + i);
    return {x, y, inside};
}

// Calls visit(lane, pixel) for the pixels of a block inside the image.
template <class Visit>
inline void for_pixels(const Frame& frame, const BlockArea& area, Visit visit) {
    for (unsigned lanes = area.inside; lanes != 0; lanes &= lanes - 1) {
        const int lane = __builtin_ctz(lanes);
        visit(lane, static_cast<size_t>(area.y + lane / kBlock) * frame.pinhole.width + area.x + lane % kBlock);
    }
}

inline void write_pixels(const Frame& frame, const BlockArea& area, float* image, int channels, int channel, Floats v) {
    float all[kLanes];
    store(all, v);
    for_pixels(frame, area, [&](int lane, size_t pixel) { image[channels * pixel + channel] = all[lane]; });
}
inline Floats read_pixels(const Frame& frame, const BlockArea& area, const float* image, int channels, int channel) {
    float all[kLanes] = {};
    if (image != nullptr)
        for_pixels(frame, area, [&](int lane, size_t pixel) { all[lane] = image[channels * pixel + channel]; });
    return load(all);
}

// A splat at the pixels of a block: whitened coordinates, and alpha before clamping.
struct SplatSample {
    Floats u, v, alpha;
};
inline SplatSample sample_splat(const Splat<Floats>& s, Floats x, Floats y) {
    const Floats dx = x - s.x, dy = y - s.y;
    const Floats u = fused(s.uu, dx, s.uv * dy), v = s.vv * dy;
    return {u, v, alpha_at(s.level, u, v)};
}

template <int kGeometry>
inline void blend_block(const Frame& frame, const BlockArea& area, const float* splats, const uint32_t* indices,
                        int count) {
    const Floats x = pixels_across() + Floats(static_cast<float>(area.x) + 0.5f);
    const Floats y = pixels_down() + Floats(static_cast<float>(area.y) + 0.5f);
    const Floats zero = Floats(0.0f), half = Floats(0.5f);
    const Floats least = Floats(frame.pinhole.min_alpha), most = Floats(kMaxAlpha);
    const Floats end = Floats(frame.pinhole.min_transmittance);
    Vec<Floats> color = {zero, zero, zero}, normal = {zero, zero, zero};
    Floats transmittance = Floats(1.0f), depth = zero, median = zero;
    Mask active = zero < transmittance;
    for (int n = 0; n < count; ++n) {
        const Splat<Floats> s = splat_at(splats + kSplatFloats * static_cast<size_t>(indices[n]));
        const SplatSample sample = sample_splat(s, x, y);
        const Floats alpha = lesser(sample.alpha, most);
        const Floats next = fused(-transmittance, alpha, transmittance);
        Mask counts = active & (least <= alpha);
        const Mask ends = counts & (next < end);
        active = active & ~ends;
        counts = counts & ~ends;
        const Floats weight = select(counts, transmittance * alpha, zero);
        color = fused(weight, s.color, color);
        if (kGeometry >= kDepth) {
            const Floats plane = fused(s.depth_u, sample.u, fused(s.depth_v, sample.v, s.depth));
            depth = fused(weight, plane, depth);
            if (kGeometry >= kNormals) {
                normal = fused(weight, s.normal, normal);
                median = select(counts & (half <= transmittance) & (next < half), plane, median);
            }
        }
        transmittance = select(counts, next, transmittance);
        if (bits(active) == 0) break;
    }
    const Images& out = frame.images;
    write_pixels(frame, area, out.transmittance, 1, 0, transmittance);
    write_pixels(frame, area, out.color, 3, 0, fused(transmittance, Floats(frame.background[0]), color.x));
    write_pixels(frame, area, out.color, 3, 1, fused(transmittance, Floats(frame.background[1]), color.y));
    write_pixels(frame, area, out.color, 3, 2, fused(transmittance, Floats(frame.background[2]), color.z));
    if (kGeometry >= kDepth) write_pixels(frame, area, out.depth, 1, 0, depth);
    if (kGeometry >= kNormals) {
        write_pixels(frame, area, out.median_depth, 1, 0, median);
        write_pixels(frame, area, out.normal, 3, 0, normal.x);
        write_pixels(frame, area, out.normal, 3, 1, normal.y);
        write_pixels(frame, area, out.normal, 3, 2, normal.z);
    }
}

// Prefetches the splat a few instances ahead, because a tile's splats are scattered in memory.
inline void fetch_ahead(const Frame& frame, const Instance* instance) {
    constexpr int kAhead = 8;
    if (instance + kAhead < frame.instances + frame.starts[frame.tiles_across * frame.tiles_down])
        __builtin_prefetch(frame.splats + kSplatFloats * static_cast<size_t>(instance[kAhead].slot));
}

inline void blend_tile(const Frame& frame, int tile, float* splats, uint32_t* indices) {
    const Instance* instances = frame.instances + frame.starts[tile];
    const uint32_t count = frame.starts[tile + 1] - frame.starts[tile];
    for (uint32_t n = 0; n < count; ++n) {
        fetch_ahead(frame, instances + n);
        store(splats + kSplatFloats * static_cast<size_t>(n),
              load(frame.splats + kSplatFloats * static_cast<size_t>(instances[n].slot)));
    }
    for (int block = 0; block < kTileBlocks; ++block) {
        const BlockArea area = block_area(frame, tile, block);
        if (area.inside == 0) continue;
        int touching = 0;
        for (uint32_t n = 0; n < count; ++n) {
            indices[touching] = n;
            touching += static_cast<int>(instances[n].blocks >> block & 1u);
        }
        if (frame.geometry == kNoGeometry)
            blend_block<kNoGeometry>(frame, area, splats, indices, touching);
        else if (frame.geometry == kDepth)
            blend_block<kDepth>(frame, area, splats, indices, touching);
        else
            blend_block<kNormals>(frame, area, splats, indices, touching);
    }
}

// State of a block's rays in the backward pass, and the gradients with respect to its pixels.
struct Rays {
    Floats x, y;
    Floats transmittance;  // 0 after the ray has ended
    Floats behind;         // see add_pixel
    PixelGradient<Floats> grad;
};

template <int kGeometry>
inline Rays rays_of(const Frame& frame, const ImageGradients& grad, const BlockArea& area) {
    const Images& images = frame.images;
    const auto read = [&](const float* image, int channels, int channel) {
        return read_pixels(frame, area, image, channels, channel);
    };
    const auto read_vector = [&](const float* image) {
        return Vec<Floats>{read(image, 3, 0), read(image, 3, 1), read(image, 3, 2)};
    };
    const Floats zero = Floats(0.0f);
    Rays r;
    r.x = pixels_across() + Floats(static_cast<float>(area.x) + 0.5f);
    r.y = pixels_down() + Floats(static_cast<float>(area.y) + 0.5f);
    float inside[kLanes];
    for (int i = 0; i < kLanes; ++i) inside[i] = static_cast<float>(area.inside >> i & 1u);
    r.transmittance = load(inside);
    r.grad.color = read_vector(grad.color);
    r.behind = fused(read(images.transmittance, 1, 0), read(grad.transmittance, 1, 0),
                     dot(read_vector(images.color), r.grad.color));
    r.grad.depth = zero;
    r.grad.normal = {zero, zero, zero};
    if (kGeometry >= kDepth) {
        r.grad.depth = read(grad.depth, 1, 0);
        r.behind = fused(read(images.depth, 1, 0), r.grad.depth, r.behind);
    }
    if (kGeometry >= kNormals) {
        r.grad.normal = read_vector(grad.normal);
        r.behind = r.behind + dot(read_vector(images.normal), r.grad.normal);
    }
    return r;
}

template <int kGeometry>
inline void blend_tile_gradient_of(const Frame& frame, const ImageGradients& grad, int tile, float* moments) {
    Rays rays[kTileBlocks];
    unsigned active = 0;
    for (int block = 0; block < kTileBlocks; ++block) {
        const BlockArea area = block_area(frame, tile, block);
        if (area.inside == 0) continue;
        rays[block] = rays_of<kGeometry>(frame, grad, area);
        active |= 1u << block;
    }
    const Floats zero = Floats(0.0f);
    const Floats least = Floats(frame.pinhole.min_alpha), most = Floats(kMaxAlpha);
    const Floats end = Floats(frame.pinhole.min_transmittance);
    constexpr int kWidth = kMomentFloats[kGeometry];
    for (uint32_t n = frame.starts[tile]; n < frame.starts[tile + 1]; ++n) {
        const Instance& instance = frame.instances[n];
        fetch_ahead(frame, &instance);
        const Splat<Floats> s = splat_at(frame.splats + kSplatFloats * static_cast<size_t>(instance.slot));
        Moments<Floats> m = {
            zero, zero, zero, zero, zero, zero, {zero, zero, zero}, zero, zero, zero, {zero, zero, zero}};
        for (unsigned blocks = instance.blocks & active; blocks != 0; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            Rays& r = rays[block];
            const SplatSample sample = sample_splat(s, r.x, r.y);
            Floats alpha = lesser(sample.alpha, most);
            const Floats next = fused(-r.transmittance, alpha, r.transmittance);
            Mask counts = least <= alpha;
            const Mask ends = counts & (next < end);
            counts = counts & ~ends;
            alpha = select(counts, alpha, zero);
            add_pixel<kGeometry>(s, sample.u, sample.v, alpha, sample.alpha < most, r.transmittance, r.grad, r.behind,
                                 m);
            r.transmittance = select(ends, zero, select(counts, next, r.transmittance));
            if (bits(zero < r.transmittance) == 0) active &= ~(1u << block);
        }
        float* out = moments + static_cast<size_t>(kWidth) * instance.emission;
        const Floats columns[kLanes] = {m.h,        m.hu,       m.hv,       m.huu,   m.huv,     m.hvv,
                                        m.color.x,  m.color.y,  m.color.z,  m.depth, m.depth_u, m.depth_v,
                                        m.normal.x, m.normal.y, m.normal.z, zero};
        store_first(out, kWidth, sums<kWidth>(columns));
    }
}

inline void blend_tile_gradient(const Frame& frame, const ImageGradients& grad, int tile, float* moments) {
    if (frame.geometry == kNoGeometry)
        blend_tile_gradient_of<kNoGeometry>(frame, grad, tile, moments);
    else if (frame.geometry == kDepth)
        blend_tile_gradient_of<kDepth>(frame, grad, tile, moments);
    else
        blend_tile_gradient_of<kNormals>(frame, grad, tile, moments);
}

}  // namespace PCB_SPACE
