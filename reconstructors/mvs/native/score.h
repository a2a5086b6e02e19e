// Photometric cost of planes: bilaterally weighted zero-mean normalised correlation of a 9 x 9 window, of which every
// second texel in both directions is used, or half of these (Schonberger et al. 2016, eq. 9, with fewer texels).
// Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "ints.h"
#include "problem.h"

namespace pcbench::mvs::PCB_ISA {

constexpr int kPatchRadius = 2, kPatchStep = 2, kPatchSide = 2 * kPatchRadius + 1;
constexpr int kPatchTexels = kPatchSide * kPatchSide;

// Precomputed values of the reference patches of sixteen pixels, for every kEvery-th texel in the order of rows: all,
// or with kEvery = 2 one colour of a chessboard.
template <int kEvery>
struct Patches {
    static constexpr int kTexels = (kPatchTexels + kEvery - 1) / kEvery;
    Floats weight[kTexels];   // they sum to one
    Floats product[kTexels];  // weight times the deviation from the weighted mean
    Floats variance, x, y, ray_x, ray_y;

    Patches permute(Ints lanes) const {
        using PCB_ISA::permute;
        Patches out;
        for (int k = 0; k < kTexels; ++k) {
            out.weight[k] = permute(weight[k], lanes);
            out.product[k] = permute(product[k], lanes);
        }
        out.variance = permute(variance, lanes);
        out.x = permute(x, lanes), out.y = permute(y, lanes);
        out.ray_x = permute(ray_x, lanes), out.ray_y = permute(ray_y, lanes);
        return out;
    }
};

// Sixteen pixels, every second one of a row. Lanes beyond the row repeat its last pixel and are not valid.
template <int kEvery>
struct Group {
    static constexpr int kTexels = Patches<kEvery>::kTexels;
    int first, y, count = 0;  // first column, row, and number of pixels inside the row
    int32_t pixel[kLanes];
    Mask valid;
    Patches<kEvery> patches;

    Group(const Problem& problem, int row, int start) : first(start), y(row) {
        float x[kLanes], counts[kLanes];
        for (int l = 0; l < kLanes; ++l) {
            const int at = first + 2 * l;
            const bool inside = at < problem.width;
            count += inside;
            const int column = inside ? at : problem.width - 1 - (problem.width - 1 - first) % 2;
            x[l] = static_cast<float>(column);
            pixel[l] = y * problem.width + column;
            counts[l] = inside && (problem.valid == nullptr || problem.valid[pixel[l]] != 0) ? 1.0f : 0.0f;
        }
        valid = Floats(0.5f) < load(counts);
        patches.x = load(x);
        patches.y = Floats(static_cast<float>(y));
        patches.ray_x = (patches.x - Floats(problem.cx)) / Floats(problem.fx);
        patches.ray_y = (patches.y - Floats(problem.cy)) / Floats(problem.fy);
        compute_weights(problem);
    }

private:
    void compute_weights(const Problem& problem) {
        Floats gray[kPatchTexels];
        int k = 0;
        for (int j = -kPatchRadius; j <= kPatchRadius; ++j) {
            const uint8_t* line =
                problem.gray + static_cast<int64_t>(clamp_index(y + kPatchStep * j, problem.height)) * problem.width;
            float values[kLanes + kPatchSide - 1];
            for (int m = 0; m < kLanes + kPatchSide - 1; ++m)
                values[m] =
                    static_cast<float>(line[clamp_index(first + kPatchStep * (m - kPatchRadius), problem.width)]);
            for (int i = 0; i < kPatchSide; ++i) gray[k++] = load(values + i);
        }
        const Floats zero = Floats(0.0f);
        Floats total = zero, mean = zero, spread = zero;
        for (k = 0; k < kTexels; ++k) {
            const Floats step = gray[kEvery * k] - gray[kPatchTexels / 2];
            patches.weight[k] = Floats(problem.space_weights[kEvery * k]) *
                                gather(problem.gray_weights, truncate(greater(step, zero - step)));
            total = total + patches.weight[k];
        }
        for (k = 0; k < kTexels; ++k) {
            patches.weight[k] = patches.weight[k] / total;
            mean = mean + patches.weight[k] * gray[kEvery * k];
        }
        for (k = 0; k < kTexels; ++k) {
            const Floats deviation = gray[kEvery * k] - mean;
            patches.product[k] = patches.weight[k] * deviation;
            spread = spread + patches.product[k] * deviation;
        }
        patches.variance = spread;
    }

    static int clamp_index(int at, int size) { return at < 0 ? 0 : at < size ? at : size - 1; }
};

// Sixteen planes, each at its pixel's depth with a normal.
struct Planes {
    Floats depth, nx, ny, nz;
};

inline Floats dot(const Planes& planes, Floats ray_x, Floats ray_y) {
    return (planes.nx * ray_x + planes.ny * ray_y) + planes.nz;
}

struct Warp {
    Floats x, y;            // projection of the pixel's point
    Floats ax, ay, bx, by;  // its derivatives with respect to the pixel's x and y
    Mask comparable;
};

constexpr float kMaxStretch = 16.0f;  // pixels of a source for one of the reference

// The homography of each plane, linearised at its pixel: over a patch the error is a hundredth of a pixel. Planes that
// cannot be compared are mapped to the first pixel.
template <int kEvery>
inline Warp warp(const Problem& problem, const Source& source, const Patches<kEvery>& at, const Planes& planes) {
    const Floats inverse = Floats(1.0f) / planes.depth;
    const float *m = source.linear, *v = source.shift;
    const auto row = [&](int r) {
        return ((Floats(m[3 * r]) * at.x + Floats(m[3 * r + 1]) * at.y) + Floats(m[3 * r + 2])) +
               Floats(v[r]) * inverse;
    };
    const Floats hx = row(0), hy = row(1), hz = row(2);
    const Floats scale = Floats(1.0f) / hz;
    const Floats u = hx * scale, w = hy * scale;
    // n K^-1 / d, with d = depth * (n . ray).
    const Floats slope = inverse / dot(planes, at.ray_x, at.ray_y);
    const Floats sx = planes.nx * slope * Floats(1.0f / problem.fx), sy = planes.ny * slope * Floats(1.0f / problem.fy);
    const auto entry = [&](int r, int column, Floats s) { return Floats(m[3 * r + column]) + Floats(v[r]) * s; };
    const Floats hzx = entry(2, 0, sx), hzy = entry(2, 1, sy);
    const Floats ax = (entry(0, 0, sx) - u * hzx) * scale, ay = (entry(1, 0, sx) - w * hzx) * scale;
    const Floats bx = (entry(0, 1, sy) - u * hzy) * scale, by = (entry(1, 1, sy) - w * hzy) * scale;
    // A patch cannot be compared if it is seen from behind or at a very different scale.
    const Floats zero = Floats(0.0f), area = ax * by - ay * bx;
    const auto length = [&](Floats a) { return greater(a, zero - a); };
    const Floats stretch = greater(greater(length(ax), length(ay)), greater(length(bx), length(by)));
    const Floats low = Floats(-0.5f), right = Floats(static_cast<float>(source.width) - 0.5f),
                 bottom = Floats(static_cast<float>(source.height) - 0.5f);
    const Mask comparable = (zero < hz) & (Floats(0.05f) < area) & (area < Floats(20.0f)) &
                            (stretch < Floats(kMaxStretch)) & (low < u) & (u < right) & (low < w) & (w < bottom);
    const auto or_zero = [&](Floats a) { return select(comparable, a, zero); };
    return {or_zero(u), or_zero(w), or_zero(ax), or_zero(ay), or_zero(bx), or_zero(by), comparable};
}

// Weighted sums over a patch of the source's values, of their squares, and of their products with the reference's. The
// source's values are scaled by kValueScale.
constexpr float kValueScale = 65025.0f;
struct Sums {
    Floats values, squares, products;
};

// Add a lattice of texels: every kStep-th row and column from kFirst on.
template <bool kInside, int kFirst, int kStep, int kEvery>
inline void accumulate_lattice(const Source& source, const Patches<kEvery>& patches, const Warp& at, Sums& sums) {
    const auto fixed = [](Floats a) { return truncate(a * Floats(65536.0f)); };
    const Ints two = Ints(kPatchStep), none = Ints(0), step = Ints(kStep);
    const Ints ax = fixed(at.ax) * two, ay = fixed(at.ay) * two, bx = fixed(at.bx) * two, by = fixed(at.by) * two;
    const Ints right = Ints((source.width - 1) << 16), bottom = Ints((source.height - 1) << 16);
    Ints line_x = fixed(at.x), line_y = fixed(at.y);
    for (int j = kFirst; j < kPatchRadius; ++j) line_x = line_x - ax - bx, line_y = line_y - ay - by;
    for (int j = kFirst; j < kPatchSide; j += kStep, line_x = line_x + step * bx, line_y = line_y + step * by) {
        Ints x = line_x, y = line_y;
        for (int i = kFirst; i < kPatchSide; i += kStep, x = x + step * ax, y = y + step * ay) {
            Ints column = x, line = y;
            if (!kInside) column = greater(lesser(x, right), none), line = greater(lesser(y, bottom), none);
            const Ints quad = gather(source.quads, pixel_index(column, line, source.width));
            const Floats value = to_floats(interpolate(quad, column, line));
            const int k = (kPatchSide * j + i) / kEvery;
            const Floats weighted = patches.weight[k] * value;
            sums.values = sums.values + weighted;
            sums.squares = sums.squares + weighted * value;
            sums.products = sums.products + patches.product[k] * value;
        }
    }
}

template <bool kInside, int kEvery>
inline Sums accumulate(const Source& source, const Patches<kEvery>& patches, const Warp& at) {
    Sums sums = {Floats(0.0f), Floats(0.0f), Floats(0.0f)};
    accumulate_lattice<kInside, 0, kEvery>(source, patches, at, sums);
    // One colour of a chessboard consists of two lattices.
    if constexpr (kEvery == 2) accumulate_lattice<kInside, 1, kEvery>(source, patches, at, sums);
    return sums;
}

// Whether all patches lie inside the source, with a margin for the rounding of coordinates.
inline bool all_inside(const Source& source, const Warp& at) {
    const Floats zero = Floats(0.0f), margin = Floats(0.01f),
                 most = Floats(static_cast<float>(kPatchStep * kPatchRadius));
    const auto length = [&](Floats a) { return greater(a, zero - a); };
    const Floats reach_x = (length(at.ax) + length(at.bx)) * most + margin;
    const Floats reach_y = (length(at.ay) + length(at.by)) * most + margin;
    const Floats right = Floats(static_cast<float>(source.width - 1));
    const Floats bottom = Floats(static_cast<float>(source.height - 1));
    const Mask inside = (reach_x < at.x) & (at.x + reach_x < right) & (reach_y < at.y) & (at.y + reach_y < bottom);
    return bits(at.comparable & ~inside) == 0;
}

// The value at the nearest pixel; x and y must lie inside the image.
inline Floats nearest_value(const Source& source, const float* map, Floats x, Floats y) {
    const Ints column = truncate(x + Floats(0.5f)), line = truncate(y + Floats(0.5f));
    return gather(map, line * Ints(static_cast<int32_t>(source.width)) + column);
}

// Reprojection error in pixels of the reference, through the source's own depth map, clamped to 3; 3 without a depth.
template <int kEvery>
inline Floats reprojection_error(const Source& source, const Patches<kEvery>& at, Floats x, Floats y) {
    const Floats depth = nearest_value(source, source.depth, x, y);
    const float *m = source.back_linear, *v = source.back_shift;
    const auto row = [&](int r) {
        return ((Floats(m[3 * r]) * x + Floats(m[3 * r + 1]) * y) + Floats(m[3 * r + 2])) * depth + Floats(v[r]);
    };
    const Floats zero = Floats(0.0f), hz = row(2);
    const Floats dx = row(0) / hz - at.x, dy = row(1) / hz - at.y;
    const Floats distance = lesser(root(dx * dx + dy * dy), Floats(3.0f));
    return select((zero < depth) & (zero < hz), distance, Floats(3.0f));
}

constexpr float kCostPerPixelError = 0.2f;  // cost per pixel of reprojection error (Xu and Tao 2019, sec. 4.2)

// The cost of each plane in one source.
template <int kEvery>
inline Floats score(const Problem& problem, const Source& source, const Patches<kEvery>& patches,
                    const Planes& planes) {
    const Warp at = warp(problem, source, patches, planes);
    const Sums sums = all_inside(source, at) ? accumulate<true, kEvery>(source, patches, at)
                                             : accumulate<false, kEvery>(source, patches, at);
    const Floats spread = sums.squares - sums.values * sums.values;
    const Floats least = Floats(problem.min_variance), least_parts = least * Floats(kValueScale * kValueScale);
    const Mask textured = (least_parts < spread) & (least < patches.variance);
    const Floats correlation =
        select(textured, sums.products / root(greater(patches.variance * spread, least_parts)), Floats(0.0f));
    Floats cost = greater(Floats(1.0f) - correlation, Floats(0.0f));
    Mask comparable = at.comparable;
    if (source.depth != nullptr || source.visible != nullptr) {
        const Floats x = greater(lesser(at.x, Floats(static_cast<float>(source.width - 1))), Floats(0.0f));
        const Floats y = greater(lesser(at.y, Floats(static_cast<float>(source.height - 1))), Floats(0.0f));
        if (source.depth != nullptr)
            cost = cost + Floats(kCostPerPixelError) * reprojection_error(source, patches, x, y);
        if (source.visible != nullptr)
            comparable = comparable & (Floats(0.5f) < nearest_value(source, source.visible, x, y));
    }
    return select(comparable, lesser(cost, Floats(kMaxCost)), Floats(kMaxCost));
}

}  // namespace pcbench::mvs::PCB_ISA
