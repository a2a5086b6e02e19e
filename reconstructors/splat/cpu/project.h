// Projection of Gaussians to splats, sixteen at a time, and its gradient.
#pragma once
#include "rows.h"

namespace PCB_SPACE {

// Sixteen Gaussians, row-major: those of a model, or copies of some of them.
struct Rows {
    const float *means, *quaternions, *scales, *opacities;
};
struct RowCopies {
    float means[3 * kLanes], quaternions[4 * kLanes], scales[3 * kLanes], opacities[kLanes];
};

// Copies the Gaussians id(0) to id(count - 1); the remaining lanes repeat the first.
template <class Id>
inline Rows copy_rows(const Model& model, int count, Id id, RowCopies& to) {
    for (int i = 0; i < kLanes; ++i) {
        const int64_t from = id(i < count ? i : 0);
        for (int k = 0; k < 3; ++k) to.means[3 * i + k] = model.means[3 * from + k];
        for (int k = 0; k < 4; ++k) to.quaternions[4 * i + k] = model.quaternions[4 * from + k];
        for (int k = 0; k < 3; ++k) to.scales[3 * i + k] = model.scales[3 * from + k];
        to.opacities[i] = model.opacities[from];
    }
    return {to.means, to.quaternions, to.scales, to.opacities};
}

struct Gaussians {
    Vec<Floats> mean, scale;
    Quaternion<Floats> quaternion;
    Floats opacity;
};
inline Gaussians gaussians_of(const Rows& rows) {
    const float* q = rows.quaternions;
    return {vector_of(rows.means),
            vector_of(rows.scales),
            {load_strided(q, 4), load_strided(q + 1, 4), load_strided(q + 2, 4), load_strided(q + 3, 4)},
            load(rows.opacities)};
}

// The spherical harmonics coefficients of sixteen drawn Gaussians from a slot on, one vector per coefficient.
inline void harmonics_of(const Frame& frame, int64_t slot, int count, Vec<Floats>* columns) {
    const int bands = frame.model.harmonic_count, width = 3 * bands;
    Floats values[3 * kMaxHarmonics];
    for (int at = 0; at < width; at += kLanes) {
        const int here = width - at < kLanes ? width - at : kLanes;
        for (int i = 0; i < kLanes; ++i) {
            const size_t id = frame.ids[slot + (i < count ? i : 0)];
            values[at + i] = load_first(frame.model.harmonics + width * id + at, here);
        }
        transpose(values + at);
    }
    for (int k = 0; k < bands; ++k) columns[k] = {values[3 * k], values[3 * k + 1], values[3 * k + 2]};
}

inline Vec<Floats> offset_of(const Pinhole& at, Vec<Floats> mean) {
    return mean - Vec<Floats>{Floats(at.position[0]), Floats(at.position[1]), Floats(at.position[2])};
}

// Computes the colours of drawn Gaussians in the directions in which they are seen.
inline void color_group(const Frame& frame, int64_t begin, int drawn) {
    const int bands = frame.model.harmonic_count;
    const Floats half = Floats(0.5f), zero = Floats(0.0f);
    for (int done = 0; done < drawn; done += kLanes) {
        const int64_t slot = begin + done;
        const int count = drawn - done < kLanes ? drawn - done : kLanes;
        float means[3 * kLanes];
        for (int i = 0; i < kLanes; ++i)
            for (int k = 0; k < 3; ++k)
                means[3 * i + k] =
                    frame.model.means[3 * static_cast<size_t>(frame.ids[slot + (i < count ? i : 0)]) + k];
        Floats basis[kMaxHarmonics];
        harmonics(unit(offset_of(frame.pinhole, vector_of(means))), bands, basis);
        Vec<Floats> columns[kMaxHarmonics];
        harmonics_of(frame, slot, count, columns);
        Vec<Floats> color = {half, half, half};
        for (int k = 0; k < bands; ++k) color = fused(basis[k], columns[k], color);
        write_vector(frame.splats + kSplatFloats * slot, kSplatFloats, 6, (1u << count) - 1u,
                     {greater(color.x, zero), greater(color.y, zero), greater(color.z, zero)});
    }
}

inline float clamp(float x, float low, float high) { return x < low ? low : x > high ? high : x; }

// The pixels of a row (or column) of `size` whose centres are within `extent` of `center`; none if first > last.
inline void pixels_within(float center, float extent, int size, int& first, int& last) {
    const float low = clamp(center - extent - 0.5f, -1.0f, static_cast<float>(size));
    const float high = clamp(center + extent - 0.5f, -1.0f, static_cast<float>(size));
    first = static_cast<int>(low);
    first += first < low;  // rounds up
    last = static_cast<int>(high);
    last -= last > high;  // rounds down
    if (first < 0) first = 0;
    if (last > size - 1) last = size - 1;
}

inline int project_group(const Frame& frame, int64_t group) {
    const Model& model = frame.model;
    const int64_t begin = group * kGroup;
    const int64_t end = begin + kGroup < model.count ? begin + kGroup : model.count;
    int drawn_count = 0;
    for (int64_t at = begin; at < end; at += kLanes) {
        const int count = end - at < kLanes ? static_cast<int>(end - at) : kLanes;
        RowCopies copies;
        const Rows rows_of = count == kLanes ? Rows{model.means + 3 * at, model.quaternions + 4 * at,
                                                    model.scales + 3 * at, model.opacities + at}
                                             : copy_rows(model, count, [&](int i) { return at + i; }, copies);
        const Gaussians g = gaussians_of(rows_of);
        Footprint<Floats> f;
        Mask drawn;
        const Splat<Floats> s = project(frame.pinhole, g.mean, g.quaternion, g.scale, g.opacity, f, drawn);
        // Both comparisons are false for NaN.
        const Floats max_extent = Floats(1e8f);
        drawn = drawn & (f.extent_x < max_extent) & (f.extent_y < max_extent);
        unsigned lanes = bits(drawn) & ((1u << count) - 1u);
        if (lanes == 0) continue;

        float x[kLanes], y[kLanes], extent_x[kLanes], extent_y[kLanes], depth[kLanes];
        store(x, s.x), store(y, s.y), store(extent_x, f.extent_x), store(extent_y, f.extent_y), store(depth, s.depth);
        const int64_t slot = begin + drawn_count;
        unsigned kept = 0;
        int rows = 0;
        for (; lanes != 0; lanes &= lanes - 1) {
            const int i = __builtin_ctz(lanes);
            int left, right, top, bottom;
            pixels_within(x[i], extent_x[i], frame.pinhole.width, left, right);
            pixels_within(y[i], extent_y[i], frame.pinhole.height, top, bottom);
            if (left > right || top > bottom) continue;
            kept |= 1u << i;
            frame.boxes[slot + rows] = {static_cast<int16_t>(left / kTile), static_cast<int16_t>(top / kTile),
                                        static_cast<int16_t>(right / kTile), static_cast<int16_t>(bottom / kTile)};
            frame.depths[slot + rows] = depth[i];
            frame.ids[slot + rows] = static_cast<uint32_t>(at + i);
            ++rows;
        }
        if (kept == 0) continue;
        float* out = frame.splats + kSplatFloats * slot;
        const Floats black = Floats(0.0f);  // until color_group
        Floats stored[kSplatFloats] = {s.x,        s.y,        s.uu,       s.uv,    s.vv,      s.level,
                                       black,      black,      black,      s.depth, s.depth_u, s.depth_v,
                                       s.normal.x, s.normal.y, s.normal.z, f.reach};
        transpose(stored);
        for (; kept != 0; kept &= kept - 1, out += kSplatFloats) store(out, stored[__builtin_ctz(kept)]);
        drawn_count += rows;
    }
    color_group(frame, begin, drawn_count);
    return drawn_count;
}

inline int cover(const Frame& frame, uint32_t slot, uint32_t* tiles, uint32_t* blocks) {
    static const float kAcross[kLanes] = {0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12, 0, 4, 8, 12};
    static const float kDown[kLanes] = {0, 0, 0, 0, 4, 4, 4, 4, 8, 8, 8, 8, 12, 12, 12, 12};
    const float* s = frame.splats + kSplatFloats * static_cast<size_t>(slot);
    const Box box = frame.boxes[slot];
    const Floats across = load(kAcross), down = load(kDown), last = Floats(kBlock - 1.0f);
    const Floats uu = Floats(s[2]), uv = Floats(s[3]), vv = Floats(s[4]);
    // The slack keeps a block whose nearest pixel lies just outside by rounding.
    const Floats reach = Floats(s[15] * 1.0001f + 1e-3f);
    int count = 0;
    for (int row = box.top; row <= box.bottom; ++row) {
        const Floats y0 = down + Floats(static_cast<float>(row * kTile) + 0.5f - s[1]);
        const int high = frame.pinhole.height - row * kTile;  // pixels of this row's tiles within the image
        for (int column = box.left; column <= box.right; ++column) {
            const Floats x0 = across + Floats(static_cast<float>(column * kTile) + 0.5f - s[0]);
            const int wide = frame.pinhole.width - column * kTile;
            const Mask inside = (across < Floats(static_cast<float>(wide))) & (down < Floats(static_cast<float>(high)));
            const Mask touched = min_squared_norm(uu, uv, vv, x0, x0 + last, y0, y0 + last) <= reach;
            const unsigned mask = bits(touched & inside);
            if (mask == 0) continue;
            tiles[count] = static_cast<uint32_t>(row * frame.tiles_across + column);
            blocks[count++] = mask;
        }
    }
    return count;
}

// The sums over pixels of sixteen drawn Gaussians, each over all of its tiles.
inline Moments<Floats> moments_of(const Frame& frame, const float* moments, const uint32_t* first,
                                  const uint32_t* count, int rows) {
    Floats sums[kLanes];  // one vector per Gaussian, then one per sum
    const int width = kMomentFloats[frame.geometry];
    for (int i = 0; i < kLanes; ++i) {
        sums[i] = Floats(0.0f);
        if (i >= rows) continue;
        const float* record = moments + static_cast<size_t>(width) * first[i];
        for (uint32_t k = 0; k < count[i]; ++k, record += width) sums[i] = sums[i] + load_first(record, width);
    }
    transpose(sums);
    return {sums[0],
            sums[1],
            sums[2],
            sums[3],
            sums[4],
            sums[5],
            {sums[6], sums[7], sums[8]},
            sums[9],
            sums[10],
            sums[11],
            {sums[12], sums[13], sums[14]}};
}

inline void project_group_gradient(const Frame& frame, int64_t group, const float* moments, const uint32_t* first,
                                   const uint32_t* count, int64_t row, const ModelGradients& out) {
    const Model& model = frame.model;
    const int64_t begin = group * kGroup;
    const int harmonic_count = model.harmonic_count, width = 3 * harmonic_count;
    for (int done = 0; done < frame.drawn[group]; done += kLanes, row += kLanes) {
        const int rows = frame.drawn[group] - done < kLanes ? frame.drawn[group] - done : kLanes;
        const int64_t slot = begin + done;
        RowCopies copies;
        const Gaussians g = gaussians_of(copy_rows(model, rows, [&](int i) { return frame.ids[slot + i]; }, copies));
        Footprint<Floats> f;
        Mask drawn;
        const Splat<Floats> s = project(frame.pinhole, g.mean, g.quaternion, g.scale, g.opacity, f, drawn);
        const Moments<Floats> m = moments_of(frame, moments, first + slot, count + slot, rows);
        Gradient<Floats> grad = project_gradient(frame.pinhole, g.scale, g.opacity, f, s, m);

        // A colour clamped at zero does not depend on the spherical harmonics.
        const Floats zero = Floats(0.0f);
        const float* splats = frame.splats + kSplatFloats * slot;
        const auto unclamped = [&](int k, Floats grad_channel) {
            return select(zero < load_strided(splats + 6 + k, kSplatFloats), grad_channel, zero);
        };
        const Vec<Floats> grad_color = {unclamped(0, m.color.x), unclamped(1, m.color.y), unclamped(2, m.color.z)};
        Floats basis[kMaxHarmonics], grad_basis[kMaxHarmonics];
        const Vec<Floats> direction = unit(f.offset);
        harmonics(direction, harmonic_count, basis);
        Vec<Floats> columns[kMaxHarmonics];
        harmonics_of(frame, slot, rows, columns);
        Floats grad_harmonics[3 * kMaxHarmonics];
        for (int k = 0; k < harmonic_count; ++k) {
            grad_basis[k] = dot(grad_color, columns[k]);
            const Vec<Floats> grad_band = basis[k] * grad_color;
            grad_harmonics[3 * k] = grad_band.x, grad_harmonics[3 * k + 1] = grad_band.y;
            grad_harmonics[3 * k + 2] = grad_band.z;
        }
        for (int at = 0; at < width; at += kLanes) {
            const int here = width - at < kLanes ? width - at : kLanes;
            transpose(grad_harmonics + at);
            for (int i = 0; i < rows; ++i)
                store_first(out.harmonics + width * (row + i) + at, here, grad_harmonics[at + i]);
        }
        grad.mean = grad.mean + unit_gradient(f.offset, harmonics_gradient(direction, harmonic_count, grad_basis));

        Floats values[kLanes] = {grad.mean.x,
                                 grad.mean.y,
                                 grad.mean.z,
                                 grad.scale.x,
                                 grad.scale.y,
                                 grad.scale.z,
                                 grad.quaternion.w,
                                 grad.quaternion.x,
                                 grad.quaternion.y,
                                 grad.quaternion.z,
                                 grad.screen_x,
                                 grad.screen_y,
                                 grad.opacity,
                                 zero,
                                 zero,
                                 zero};
        transpose(values);
        for (int i = 0; i < rows; ++i) {
            float all[kLanes];
            store(all, values[i]);
            __builtin_memcpy(out.means + 3 * (row + i), all, 3 * sizeof(float));
            __builtin_memcpy(out.scales + 3 * (row + i), all + 3, 3 * sizeof(float));
            __builtin_memcpy(out.quaternions + 4 * (row + i), all + 6, 4 * sizeof(float));
            __builtin_memcpy(out.screen + 2 * (row + i), all + 10, 2 * sizeof(float));
            out.opacities[row + i] = all[12];
        }
    }
}

}  // namespace PCB_SPACE
