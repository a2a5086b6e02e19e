// How well planes through pixels of one image explain others: bilaterally weighted zero-mean normalised correlation of
// a 9 x 9 window of which every second texel is taken (Schonberger et al. 2016, eq. 9, with fewer texels).
// Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "floats.h"
#include "problem.h"

namespace pcbench::mvs::PCB_ISA {

constexpr int kReach = 2, kStep = 2, kSide = 2 * kReach + 1, kTexels = kSide * kSide;

// Sixteen pixels, every second one of a row, and what their patches need in each comparison. The pixels beyond the row
// repeat its last one.
struct Group {
    int y = 0, count = 0;
    int x[kLanes];
    int64_t pixel[kLanes];
    float ray_x[kLanes], ray_y[kLanes];
    float weight[kTexels][kLanes];   // of sum one
    float product[kTexels][kLanes];  // weight times the deviation from the weighted mean
    float variance[kLanes];

    Group(const Problem& problem, int row, int first) : y(row) {
        for (int l = 0; l < kLanes; ++l) {
            const int at = first + 2 * l;
            if (at < problem.width) count = l + 1;
            x[l] = at < problem.width ? at : x[l - 1];
            pixel[l] = static_cast<int64_t>(y) * problem.width + x[l];
            ray_x[l] = (static_cast<float>(x[l]) - problem.cx) / problem.fx;
            ray_y[l] = (static_cast<float>(y) - problem.cy) / problem.fy;
        }
        float gray[kTexels][kLanes];
        int k = 0;
        for (int j = -kReach; j <= kReach; ++j)
            for (int i = -kReach; i <= kReach; ++i, ++k) {
                const uint8_t* line =
                    problem.gray + static_cast<int64_t>(clamped(y + kStep * j, problem.height)) * problem.width;
                for (int l = 0; l < kLanes; ++l) {
                    const int here = problem.gray[pixel[l]], there = line[clamped(x[l] + kStep * i, problem.width)];
                    gray[k][l] = static_cast<float>(there);
                    weight[k][l] = problem.patch_weights[k][here < there ? there - here : here - there];
                }
            }
        Floats total = splat(0.0f), mean = splat(0.0f), spread = splat(0.0f);
        for (k = 0; k < kTexels; ++k) total = total + load(weight[k]);
        for (k = 0; k < kTexels; ++k) {
            store(weight[k], load(weight[k]) / total);
            mean = mean + load(weight[k]) * load(gray[k]);
        }
        for (k = 0; k < kTexels; ++k) {
            const Floats deviation = load(gray[k]) - mean;
            store(product[k], load(weight[k]) * deviation);
            spread = spread + load(product[k]) * deviation;
        }
        store(variance, spread);
    }

    static int clamped(int at, int size) { return at < 0 ? 0 : at < size ? at : size - 1; }
};

// Planes to compare, each through a pixel of the group.
struct Planes {
    int count = 0;
    int lane[kLanes];
    float depth[kLanes], nx[kLanes], ny[kLanes], nz[kLanes];
};

// The patches of the planes' pixels, lane by lane.
struct Patches {
    float weight[kTexels][kLanes], product[kTexels][kLanes];
    float variance[kLanes], x[kLanes], y[kLanes], ray_x[kLanes], ray_y[kLanes];

    Patches(const Group& group, const Planes& planes) {
        for (int k = 0; k < kTexels; ++k)
            for (int l = 0; l < kLanes; ++l) {
                weight[k][l] = group.weight[k][planes.lane[l]];
                product[k][l] = group.product[k][planes.lane[l]];
            }
        for (int l = 0; l < kLanes; ++l) {
            const int from = planes.lane[l];
            variance[l] = group.variance[from];
            x[l] = static_cast<float>(group.x[from]);
            y[l] = static_cast<float>(group.y);
            ray_x[l] = group.ray_x[from];
            ray_y[l] = group.ray_y[from];
        }
    }
};

struct Warp {
    Floats x, y;            // where the pixel's point is seen
    Floats ax, ay, bx, by;  // how that moves with the pixel, to the right and down
    Mask seen;
};

// The homography of each plane, to first order about its pixel: over a patch the rest is a hundredth of a pixel.
inline Warp warp(const Problem& problem, const Source& source, const Patches& at, const Planes& planes) {
    const Floats px = load(at.x), py = load(at.y), nx = load(planes.nx), ny = load(planes.ny), nz = load(planes.nz);
    const Floats inverse = splat(1.0f) / load(planes.depth);
    const float *m = source.turn, *v = source.shift;
    const auto row = [&](int r) {
        return ((splat(m[3 * r]) * px + splat(m[3 * r + 1]) * py) + splat(m[3 * r + 2])) + splat(v[r]) * inverse;
    };
    const Floats hx = row(0), hy = row(1), hz = row(2);
    const Floats scale = splat(1.0f) / hz;
    const Floats u = hx * scale, w = hy * scale;
    // n K^-1 / d, with d = depth * (n . ray).
    const Floats facing = (nx * load(at.ray_x) + ny * load(at.ray_y)) + nz;
    const Floats slope = inverse / facing;
    const Floats sx = nx * slope * splat(1.0f / problem.fx), sy = ny * slope * splat(1.0f / problem.fy);
    const auto entry = [&](int r, int column, Floats s) { return splat(m[3 * r + column]) + splat(v[r]) * s; };
    const Floats hzx = entry(2, 0, sx), hzy = entry(2, 1, sy);
    Warp out;
    out.x = u;
    out.y = w;
    out.ax = (entry(0, 0, sx) - u * hzx) * scale;
    out.ay = (entry(1, 0, sx) - w * hzx) * scale;
    out.bx = (entry(0, 1, sy) - u * hzy) * scale;
    out.by = (entry(1, 1, sy) - w * hzy) * scale;
    // A patch that is seen from behind, or at another scale by far, cannot be compared.
    const Floats area = out.ax * out.by - out.ay * out.bx;
    const Floats low = splat(-0.5f), right = splat(static_cast<float>(source.width) - 0.5f),
                 bottom = splat(static_cast<float>(source.height) - 0.5f);
    out.seen = (splat(0.0f) < hz) & (splat(0.05f) < area) & (area < splat(20.0f)) & (low < u) & (u < right) &
               (low < w) & (w < bottom);
    return out;
}

inline Floats bilinear(const Source& source, Floats x, Floats y) {
    const Floats zero = splat(0.0f);
    x = max(min(x, splat(static_cast<float>(source.width - 1))), zero);
    y = max(min(y, splat(static_cast<float>(source.height - 1))), zero);
    const Ints column = truncated(x), line = truncated(y);
    const Ints quad = gather(source.quads, line * splat(static_cast<int32_t>(source.width)) + column);
    const Floats fx = x - floats(column), fy = y - floats(line);
    const Ints byte = splat(static_cast<int32_t>(255));
    const Floats p00 = floats(quad & byte), p10 = floats(shifted_right<8>(quad) & byte);
    const Floats p01 = floats(shifted_right<16>(quad) & byte), p11 = floats(shifted_right<24>(quad));
    const Floats upper = p00 + fx * (p10 - p00), lower = p01 + fx * (p11 - p01);
    return upper + fy * (lower - upper);
}

// The value of the pixel whose centre is nearest; x and y are taken to the border first.
inline Floats nearest(const Source& source, const float* map, Floats x, Floats y) {
    const Ints column = truncated(x + splat(0.5f)), line = truncated(y + splat(0.5f));
    return gather(map, line * splat(static_cast<int32_t>(source.width)) + column);
}

// How far, in pixels of the reference, the source's own depth map puts the point it shows there; at most 3. None is 3.
inline Floats disagreement(const Source& source, const Patches& at, Floats x, Floats y) {
    const Floats depth = nearest(source, source.depth, x, y);
    const float *m = source.back_turn, *v = source.back_shift;
    const auto row = [&](int r) {
        return ((splat(m[3 * r]) * x + splat(m[3 * r + 1]) * y) + splat(m[3 * r + 2])) * depth + splat(v[r]);
    };
    const Floats zero = splat(0.0f), hz = row(2);
    const Floats dx = row(0) / hz - load(at.x), dy = row(1) / hz - load(at.y);
    const Floats distance = min(sqrt(dx * dx + dy * dy), splat(3.0f));
    return select((zero < depth) & (zero < hz), distance, splat(3.0f));
}

constexpr float kPerPixelOff = 0.2f;  // the cost of a pixel of disagreement (Xu and Tao 2019, sec. 4.2)

// costs[s][l]: of plane l in source s.
inline void score(const Problem& problem, const Group& group, const Planes& planes, float (*costs)[kLanes]) {
    const Patches patches(group, planes);
    const Floats variance = load(patches.variance);
    for (int s = 0; s < problem.source_count; ++s) {
        const Source& source = problem.sources[s];
        const Warp at = warp(problem, source, patches, planes);
        Floats sum = splat(0.0f), squares = splat(0.0f), covariance = splat(0.0f);
        int k = 0;
        for (int j = -kReach; j <= kReach; ++j) {
            const Floats dy = splat(static_cast<float>(kStep * j));
            const Floats x0 = at.x + at.bx * dy, y0 = at.y + at.by * dy;
            for (int i = -kReach; i <= kReach; ++i, ++k) {
                const Floats dx = splat(static_cast<float>(kStep * i));
                const Floats value = bilinear(source, x0 + at.ax * dx, y0 + at.ay * dx);
                const Floats weighted = load(patches.weight[k]) * value;
                sum = sum + weighted;
                squares = squares + weighted * value;
                covariance = covariance + load(patches.product[k]) * value;
            }
        }
        const Floats spread = squares - sum * sum, least = splat(problem.least_variance);
        const Mask textured = (least < spread) & (least < variance);
        const Floats correlation = select(textured, covariance / sqrt(max(variance * spread, least)), splat(0.0f));
        Floats cost = max(splat(1.0f) - correlation, splat(0.0f));
        Mask seen = at.seen;
        if (source.depth != nullptr || source.shown != nullptr) {
            const Floats x = max(min(at.x, splat(static_cast<float>(source.width - 1))), splat(0.0f));
            const Floats y = max(min(at.y, splat(static_cast<float>(source.height - 1))), splat(0.0f));
            if (source.depth != nullptr) cost = cost + splat(kPerPixelOff) * disagreement(source, patches, x, y);
            if (source.shown != nullptr) seen = seen & (splat(0.5f) < nearest(source, source.shown, x, y));
        }
        store(costs[s], select(seen, min(cost, splat(kWorst)), splat(kWorst)));
    }
}

}  // namespace pcbench::mvs::PCB_ISA
