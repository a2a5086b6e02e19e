// From splats to pixels and back, a tile at a time, a block of 4 x 4 pixels being one SIMD vector.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

// Offsets of a block's pixels from its first.
inline Floats pixels_across() {
    static const float kAcross[kLanes] = {0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3, 0, 1, 2, 3};
    return load(kAcross);
}
inline Floats pixels_down() {
    static const float kDown[kLanes] = {0, 0, 0, 0, 1, 1, 1, 1, 2, 2, 2, 2, 3, 3, 3, 3};
    return load(kDown);
}

// A splat as it is stored, the same in every lane.
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

// Where a tile's block lies, and which of its pixels are in the picture.
struct Place {
    int x, y;
    unsigned inside;
};
inline Place place_of(const Frame& frame, int tile, int block) {
    const int x = tile % frame.tiles_across * kTile + block % kBlocksAcross * kBlock;
    const int y = tile / frame.tiles_across * kTile + block / kBlocksAcross * kBlock;
    unsigned inside = 0;
    for (int j = 0; j < kBlock; ++j)
        for (int i = 0; i < kBlock; ++i)
            if (x + i < frame.pinhole.width && y + j < frame.pinhole.height) inside |= 1u << (kBlock * j + i);
    return {x, y, inside};
}

// Calls each(lane, pixel) for the pixels of a block that are in the picture.
template <class Each>
inline void for_pixels(const Frame& frame, const Place& place, Each each) {
    for (unsigned left = place.inside; left != 0; left &= left - 1) {
        const int lane = __builtin_ctz(left);
        each(lane, static_cast<size_t>(place.y + lane / kBlock) * frame.pinhole.width + place.x + lane % kBlock);
    }
}

inline void write_pixels(const Frame& frame, const Place& place, float* picture, int channels, int channel, Floats v) {
    float all[kLanes];
    store(all, v);
    for_pixels(frame, place, [&](int lane, size_t pixel) { picture[channels * pixel + channel] = all[lane]; });
}
inline Floats read_pixels(const Frame& frame, const Place& place, const float* picture, int channels, int channel) {
    float all[kLanes] = {};
    if (picture != nullptr)
        for_pixels(frame, place, [&](int lane, size_t pixel) { all[lane] = picture[channels * pixel + channel]; });
    return load(all);
}

// What a block shows of a splat: its whitened coordinates, and the alpha before it is held.
struct Seen {
    Floats u, v, alpha;
};
inline Seen seen_of(const Splat<Floats>& s, Floats x, Floats y) {
    const Floats dx = x - s.x, dy = y - s.y;
    const Floats u = fused(s.uu, dx, s.uv * dy), v = s.vv * dy;
    return {u, v, alpha_at(s.level, u, v)};
}

template <bool kGeometry>
inline void blend_block(const Frame& frame, const Place& place, const float* splats, const uint32_t* listed,
                        int count) {
    const Floats x = pixels_across() + Floats(static_cast<float>(place.x) + 0.5f);
    const Floats y = pixels_down() + Floats(static_cast<float>(place.y) + 0.5f);
    const Floats zero = Floats(0.0f), half = Floats(0.5f);
    const Floats least = Floats(kLeastAlpha), most = Floats(kMostAlpha), end = Floats(kLeastTransmittance);
    Vec<Floats> color = {zero, zero, zero}, normal = {zero, zero, zero};
    Floats left = Floats(1.0f), depth = zero, median = zero;
    Mask going = zero < left;
    for (int n = 0; n < count; ++n) {
        const Splat<Floats> s = splat_at(splats + kSplatFloats * static_cast<size_t>(listed[n]));
        const Seen seen = seen_of(s, x, y);
        const Floats alpha = lesser(seen.alpha, most);
        const Floats next = fused(-left, alpha, left);
        Mask counts = going & (least <= alpha);
        const Mask ends = counts & (next < end);
        going = going & ~ends;
        counts = counts & ~ends;
        const Floats weight = select(counts, left * alpha, zero);
        color = fused(weight, s.color, color);
        if (kGeometry) {
            const Floats plane = fused(s.depth_u, seen.u, fused(s.depth_v, seen.v, s.depth));
            depth = fused(weight, plane, depth);
            normal = fused(weight, s.normal, normal);
            median = select(counts & (half <= left) & (next < half), plane, median);
        }
        left = select(counts, next, left);
        if (bits(going) == 0) break;
    }
    const Pictures& out = frame.pictures;
    write_pixels(frame, place, out.transmittance, 1, 0, left);
    write_pixels(frame, place, out.color, 3, 0, fused(left, Floats(frame.background[0]), color.x));
    write_pixels(frame, place, out.color, 3, 1, fused(left, Floats(frame.background[1]), color.y));
    write_pixels(frame, place, out.color, 3, 2, fused(left, Floats(frame.background[2]), color.z));
    if (kGeometry) {
        write_pixels(frame, place, out.depth, 1, 0, depth);
        write_pixels(frame, place, out.median_depth, 1, 0, median);
        write_pixels(frame, place, out.normal, 3, 0, normal.x);
        write_pixels(frame, place, out.normal, 3, 1, normal.y);
        write_pixels(frame, place, out.normal, 3, 2, normal.z);
    }
}

// A tile's splats lie anywhere in memory: they are asked for some instances before they are needed.
inline void fetch_ahead(const Frame& frame, const Instance* instance) {
    constexpr int kAhead = 8;
    if (instance + kAhead < frame.instances + frame.starts[frame.tiles_across * frame.tiles_down])
        __builtin_prefetch(frame.splats + kSplatFloats * static_cast<size_t>(instance[kAhead].slot));
}

inline void blend_tile(const Frame& frame, int tile, float* splats, uint32_t* listed) {
    const Instance* instances = frame.instances + frame.starts[tile];
    const uint32_t count = frame.starts[tile + 1] - frame.starts[tile];
    for (uint32_t n = 0; n < count; ++n) {
        fetch_ahead(frame, instances + n);
        store(splats + kSplatFloats * static_cast<size_t>(n),
              load(frame.splats + kSplatFloats * static_cast<size_t>(instances[n].slot)));
    }
    for (int block = 0; block < kTileBlocks; ++block) {
        const Place place = place_of(frame, tile, block);
        if (place.inside == 0) continue;
        int touching = 0;
        for (uint32_t n = 0; n < count; ++n) {
            listed[touching] = n;
            touching += static_cast<int>(instances[n].blocks >> block & 1u);
        }
        if (frame.geometry)
            blend_block<true>(frame, place, splats, listed, touching);
        else
            blend_block<false>(frame, place, splats, listed, touching);
    }
}

// What the derivative knows of a block: as far as it has come along the rays, and what its pixels ask for.
struct Rays {
    Floats x, y;
    Floats left;    // transmittance; 0 where the ray has ended
    Floats behind;  // see add_pixel
    PixelGradient<Floats> by;
    Floats error;
};

template <bool kGeometry>
inline Rays rays_of(const Frame& frame, const PictureGradients& by, const Place& place) {
    const Pictures& shown = frame.pictures;
    const auto read = [&](const float* picture, int channels, int channel) {
        return read_pixels(frame, place, picture, channels, channel);
    };
    const auto read_vector = [&](const float* picture) {
        return Vec<Floats>{read(picture, 3, 0), read(picture, 3, 1), read(picture, 3, 2)};
    };
    const Floats zero = Floats(0.0f);
    Rays r;
    r.x = pixels_across() + Floats(static_cast<float>(place.x) + 0.5f);
    r.y = pixels_down() + Floats(static_cast<float>(place.y) + 0.5f);
    float inside[kLanes];
    for (int i = 0; i < kLanes; ++i) inside[i] = static_cast<float>(place.inside >> i & 1u);
    r.left = load(inside);
    r.by.color = read_vector(by.color);
    r.error = read(by.error, 1, 0);
    r.behind =
        fused(read(shown.transmittance, 1, 0), read(by.transmittance, 1, 0), dot(read_vector(shown.color), r.by.color));
    r.by.depth = zero;
    r.by.normal = {zero, zero, zero};
    if (kGeometry) {
        r.by.depth = read(by.depth, 1, 0);
        r.by.normal = read_vector(by.normal);
        r.behind = fused(read(shown.depth, 1, 0), r.by.depth, r.behind);
        r.behind = r.behind + dot(read_vector(shown.normal), r.by.normal);
    }
    return r;
}

template <bool kGeometry>
inline void blend_tile_gradient_of(const Frame& frame, const PictureGradients& by, int tile, float* moments) {
    Rays rays[kTileBlocks];
    unsigned going = 0;
    for (int block = 0; block < kTileBlocks; ++block) {
        const Place place = place_of(frame, tile, block);
        if (place.inside == 0) continue;
        rays[block] = rays_of<kGeometry>(frame, by, place);
        going |= 1u << block;
    }
    const Floats zero = Floats(0.0f), one = Floats(1.0f);
    const Floats least = Floats(kLeastAlpha), most = Floats(kMostAlpha), end = Floats(kLeastTransmittance);
    constexpr int kWidth = kGeometry ? kMomentFloats : kPlainMomentFloats;
    for (uint32_t n = frame.starts[tile]; n < frame.starts[tile + 1]; ++n) {
        const Instance& instance = frame.instances[n];
        fetch_ahead(frame, &instance);
        const Splat<Floats> s = splat_at(frame.splats + kSplatFloats * static_cast<size_t>(instance.slot));
        Moments<Floats> m = {
            zero, zero, zero, zero, zero, zero, {zero, zero, zero}, zero, zero, zero, zero, zero, {zero, zero, zero}};
        for (unsigned blocks = instance.blocks & going; blocks != 0; blocks &= blocks - 1) {
            const int block = __builtin_ctz(blocks);
            Rays& r = rays[block];
            const Seen seen = seen_of(s, r.x, r.y);
            Floats alpha = lesser(seen.alpha, most);
            const Floats next = fused(-r.left, alpha, r.left);
            Mask counts = least <= alpha;
            const Mask ends = counts & (next < end);
            counts = counts & ~ends;
            alpha = select(counts, alpha, zero);
            const Floats free = select(seen.alpha < most, one, zero);
            add_pixel<kGeometry>(s, seen.u, seen.v, alpha, free, r.left, r.by, r.error, r.behind, m);
            r.left = select(ends, zero, select(counts, next, r.left));
            if (bits(zero < r.left) == 0) going &= ~(1u << block);
        }
        float* out = moments + static_cast<size_t>(kWidth) * instance.emission;
        const Floats columns[kLanes] = {m.h,       m.hu,      m.hv,       m.huu,     m.huv,   m.hvv,
                                        m.color.x, m.color.y, m.color.z,  m.weight,  m.error, m.depth,
                                        m.depth_u, m.depth_v, m.normal.x, m.normal.y};
        if (kGeometry) {
            store(out, sums(columns));
            out[kLanes] = sum(m.normal.z);
        } else {
            store_first(out, kPlainMomentFloats, sums(columns));
        }
    }
}

inline void blend_tile_gradient(const Frame& frame, const PictureGradients& by, int tile, float* moments) {
    if (frame.geometry)
        blend_tile_gradient_of<true>(frame, by, tile, moments);
    else
        blend_tile_gradient_of<false>(frame, by, tile, moments);
}

}  // namespace PCB_SPACE
