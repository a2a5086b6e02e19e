// How well planes through pixels of one image explain others: bilaterally weighted zero-mean normalised correlation of
// a 9 x 9 window of which every second texel is taken (Schonberger et al. 2016, eq. 9, with fewer texels).
// Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "ints.h"
#include "problem.h"

namespace pcbench::mvs::PCB_ISA {

constexpr int kReach = 2, kStep = 2, kSide = 2 * kReach + 1, kTexels = kSide * kSide;

// What the patches of sixteen pixels need in each comparison.
struct Patches {
    Floats weight[kTexels];   // of sum one
    Floats product[kTexels];  // weight times the deviation from the weighted mean
    Floats variance, x, y, ray_x, ray_y;

    Patches permuted(Ints lanes) const {
        using PCB_ISA::permuted;
        Patches out;
        for (int k = 0; k < kTexels; ++k) {
            out.weight[k] = permuted(weight[k], lanes);
            out.product[k] = permuted(product[k], lanes);
        }
        out.variance = permuted(variance, lanes);
        out.x = permuted(x, lanes), out.y = permuted(y, lanes);
        out.ray_x = permuted(ray_x, lanes), out.ray_y = permuted(ray_y, lanes);
        return out;
    }
};

// Sixteen pixels, every second one of a row from the first. Those beyond the row repeat its last one and do not count.
struct Group {
    int first, y, count = 0;  // of those within the row
    int32_t pixel[kLanes];
    Mask valid;
    Patches patches;

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
        weigh(problem);
    }

private:
    void weigh(const Problem& problem) {
        Floats gray[kTexels];
        int k = 0;
        for (int j = -kReach; j <= kReach; ++j) {
            const uint8_t* line =
                problem.gray + static_cast<int64_t>(clamped(y + kStep * j, problem.height)) * problem.width;
            float values[kLanes + kSide - 1];
            for (int m = 0; m < kLanes + kSide - 1; ++m)
                values[m] = static_cast<float>(line[clamped(first + kStep * (m - kReach), problem.width)]);
            for (int i = 0; i < kSide; ++i) gray[k++] = load(values + i);
        }
        const Floats zero = Floats(0.0f);
        Floats total = zero, mean = zero, spread = zero;
        for (k = 0; k < kTexels; ++k) {
            const Floats step = gray[k] - gray[kTexels / 2];
            patches.weight[k] =
                Floats(problem.space_weights[k]) * gather(problem.gray_weights, truncated(greater(step, zero - step)));
            total = total + patches.weight[k];
        }
        for (k = 0; k < kTexels; ++k) {
            patches.weight[k] = patches.weight[k] / total;
            mean = mean + patches.weight[k] * gray[k];
        }
        for (k = 0; k < kTexels; ++k) {
            const Floats deviation = gray[k] - mean;
            patches.product[k] = patches.weight[k] * deviation;
            spread = spread + patches.product[k] * deviation;
        }
        patches.variance = spread;
    }

    static int clamped(int at, int size) { return at < 0 ? 0 : at < size ? at : size - 1; }
};

// Sixteen planes, each through a pixel.
struct Planes {
    Floats depth, nx, ny, nz;
};

inline Floats dot(const Planes& planes, Floats ray_x, Floats ray_y) {
    return (planes.nx * ray_x + planes.ny * ray_y) + planes.nz;
}

struct Warp {
    Floats x, y;            // where the pixel's point is seen
    Floats ax, ay, bx, by;  // how that moves with the pixel, to the right and down
    Mask seen;
};

constexpr float kMostStretched = 16.0f;  // pixels of a source for one of the reference

// The homography of each plane, to first order about its pixel: over a patch the rest is a hundredth of a pixel. What
// cannot be compared is put into the first pixel.
inline Warp warp(const Problem& problem, const Source& source, const Patches& at, const Planes& planes) {
    const Floats inverse = Floats(1.0f) / planes.depth;
    const float *m = source.turn, *v = source.shift;
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
    // A patch that is seen from behind, or at another scale by far, cannot be compared.
    const Floats zero = Floats(0.0f), area = ax * by - ay * bx;
    const auto length = [&](Floats a) { return greater(a, zero - a); };
    const Floats stretched = greater(greater(length(ax), length(ay)), greater(length(bx), length(by)));
    const Floats low = Floats(-0.5f), right = Floats(static_cast<float>(source.width) - 0.5f),
                 bottom = Floats(static_cast<float>(source.height) - 0.5f);
    const Mask seen = (zero < hz) & (Floats(0.05f) < area) & (area < Floats(20.0f)) &
                      (stretched < Floats(kMostStretched)) & (low < u) & (u < right) & (low < w) & (w < bottom);
    const auto kept = [&](Floats a) { return select(seen, a, zero); };
    return {kept(u), kept(w), kept(ax), kept(ay), kept(bx), kept(by), seen};
}

// The weighted sums over a patch of the source's values, their squares, and their products with the reference's; values
// are in parts of a grey level.
constexpr float kParts = 65025.0f;
struct Sums {
    Floats values, squares, products;
};

template <bool kWhole>
inline Sums summed(const Source& source, const Patches& patches, const Warp& at) {
    const auto fixed = [](Floats a) { return truncated(a * Floats(65536.0f)); };
    const Ints two = Ints(kStep), none = Ints(0);
    const Ints ax = fixed(at.ax) * two, ay = fixed(at.ay) * two, bx = fixed(at.bx) * two, by = fixed(at.by) * two;
    const Ints right = Ints((source.width - 1) << 16), bottom = Ints((source.height - 1) << 16);
    Ints line_x = fixed(at.x), line_y = fixed(at.y);
    for (int j = 0; j < kReach; ++j) line_x = line_x - ax - bx, line_y = line_y - ay - by;
    Floats values = Floats(0.0f), squares = values, products = values;
    for (int k = 0; k < kTexels; line_x = line_x + bx, line_y = line_y + by) {
        Ints x = line_x, y = line_y;
        for (int i = 0; i < kSide; ++i, ++k, x = x + ax, y = y + ay) {
            Ints column = x, line = y;
            if (!kWhole) column = greater(lesser(x, right), none), line = greater(lesser(y, bottom), none);
            const Ints quad = gather(source.quads, element(column, line, source.width));
            const Floats value = floats(between(quad, column, line));
            const Floats weighted = patches.weight[k] * value;
            values = values + weighted;
            squares = squares + weighted * value;
            products = products + patches.product[k] * value;
        }
    }
    return {values, squares, products};
}

// Whether all patches lie within the source, by more than the coordinates are rounded.
inline bool whole(const Source& source, const Warp& at) {
    const Floats zero = Floats(0.0f), margin = Floats(0.01f), most = Floats(static_cast<float>(kStep * kReach));
    const auto length = [&](Floats a) { return greater(a, zero - a); };
    const Floats reach_x = (length(at.ax) + length(at.bx)) * most + margin;
    const Floats reach_y = (length(at.ay) + length(at.by)) * most + margin;
    const Floats right = Floats(static_cast<float>(source.width - 1));
    const Floats bottom = Floats(static_cast<float>(source.height - 1));
    const Mask inside = (reach_x < at.x) & (at.x + reach_x < right) & (reach_y < at.y) & (at.y + reach_y < bottom);
    return bits(at.seen & ~inside) == 0;
}

// The value of the pixel whose centre is nearest; x and y are taken to the border first.
inline Floats nearest(const Source& source, const float* map, Floats x, Floats y) {
    const Ints column = truncated(x + Floats(0.5f)), line = truncated(y + Floats(0.5f));
    return gather(map, line * Ints(static_cast<int32_t>(source.width)) + column);
}

// How far, in pixels of the reference, the source's own depth map puts the point it shows there; at most 3. None is 3.
inline Floats disagreement(const Source& source, const Patches& at, Floats x, Floats y) {
    const Floats depth = nearest(source, source.depth, x, y);
    const float *m = source.back_turn, *v = source.back_shift;
    const auto row = [&](int r) {
        return ((Floats(m[3 * r]) * x + Floats(m[3 * r + 1]) * y) + Floats(m[3 * r + 2])) * depth + Floats(v[r]);
    };
    const Floats zero = Floats(0.0f), hz = row(2);
    const Floats dx = row(0) / hz - at.x, dy = row(1) / hz - at.y;
    const Floats distance = lesser(root(dx * dx + dy * dy), Floats(3.0f));
    return select((zero < depth) & (zero < hz), distance, Floats(3.0f));
}

constexpr float kPerPixelOff = 0.2f;  // the cost of a pixel of disagreement (Xu and Tao 2019, sec. 4.2)

// Of each plane in one source.
inline Floats score(const Problem& problem, const Source& source, const Patches& patches, const Planes& planes) {
    const Warp at = warp(problem, source, patches, planes);
    const Sums sums = whole(source, at) ? summed<true>(source, patches, at) : summed<false>(source, patches, at);
    const Floats spread = sums.squares - sums.values * sums.values;
    const Floats least = Floats(problem.least_variance), least_parts = least * Floats(kParts * kParts);
    const Mask textured = (least_parts < spread) & (least < patches.variance);
    const Floats correlation =
        select(textured, sums.products / root(greater(patches.variance * spread, least_parts)), Floats(0.0f));
    Floats cost = greater(Floats(1.0f) - correlation, Floats(0.0f));
    Mask seen = at.seen;
    if (source.depth != nullptr || source.shown != nullptr) {
        const Floats x = greater(lesser(at.x, Floats(static_cast<float>(source.width - 1))), Floats(0.0f));
        const Floats y = greater(lesser(at.y, Floats(static_cast<float>(source.height - 1))), Floats(0.0f));
        if (source.depth != nullptr) cost = cost + Floats(kPerPixelOff) * disagreement(source, patches, x, y);
        if (source.shown != nullptr) seen = seen & (Floats(0.5f) < nearest(source, source.shown, x, y));
    }
    return select(seen, lesser(cost, Floats(kWorst)), Floats(kWorst));
}

}  // namespace pcbench::mvs::PCB_ISA
