// The neighbours whose planes a pixel may take over: the one of least cost in each of eight regions, four wedges nearby
// and four lines further away (Xu and Tao 2019, sec. 3.1). Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "candidates.h"

namespace pcbench::mvs::PCB_ISA {

constexpr int kRegions = 8;
constexpr float kNothing = 10.0f;  // the cost of what lies beyond the image or is not valid

struct Region {
    int count;
    int32_t dx[11], dy[11];
};

// Of a side (down, up, right, left) the wedge or the line; all lead to pixels of the other colour.
constexpr Region region(int number) {
    constexpr int kAcross[7] = {0, -1, 1, -2, 2, -3, 3}, kAlong[7] = {1, 2, 2, 3, 3, 4, 4};
    const int side = number % 4;
    const bool wedge = number < 4;
    Region out{wedge ? 7 : 11, {}, {}};
    for (int k = 0; k < out.count; ++k) {
        const int across = wedge ? kAcross[k] : 0, along = wedge ? kAlong[k] : 5 + 2 * k;
        out.dx[k] = side < 2 ? across : side == 2 ? along : -along;
        out.dy[k] = side >= 2 ? across : side == 0 ? along : -along;
    }
    return out;
}

constexpr Region kRegion[kRegions] = {region(0), region(1), region(2), region(3),
                                      region(4), region(5), region(6), region(7)};

// The costs of the pixels of one colour into the room for them.
inline void lay_beside(const Problem& problem, State& state, int colour) {
#pragma omp parallel for
    for (int64_t row = 0; row < problem.height + 2 * kBesideAbove; ++row) {
        float* line = state.beside + row * state.beside_columns;
        for (int64_t i = 0; i < state.beside_columns; ++i) line[i] = kNothing;
        const int64_t y = row - kBesideAbove;
        if (y < 0 || y >= problem.height) continue;
        for (int64_t x = (y + colour) & 1; x < problem.width; x += 2) {
            const int64_t at = y * problem.width + x;
            if (problem.valid == nullptr || problem.valid[at] != 0) line[kBesideLeft + x / 2] = state.cost[at];
        }
    }
}

// A pixel for each of the group's, and how far away; where none is found, or asked for, the same one.
struct Neighbor {
    Mask found;
    Ints pixel;
    Floats dx, dy;
};

inline Neighbor best_of_region(const Problem& problem, const State& state, const Group& group, int number) {
    const Region& steps = kRegion[number];
    Floats least = Floats(kNothing), best = Floats(-1.0f);
    for (int k = 0; k < steps.count; ++k) {
        const int64_t row = group.y + steps.dy[k] + kBesideAbove;
        const int64_t column = ((group.first + steps.dx[k]) >> 1) + kBesideLeft;
        const Floats cost = load(state.beside + row * state.beside_columns + column);
        best = select(cost < least, Floats(static_cast<float>(k)), best);
        least = lesser(cost, least);
    }
    const Mask found = group.valid & (Floats(-0.5f) < best);
    const Ints step = truncated(greater(best, Floats(0.0f)));
    const Floats none = Floats(0.0f);
    const Floats dx = select(found, floats(gather(steps.dx, step)), none);
    const Floats dy = select(found, floats(gather(steps.dy, step)), none);
    const Ints away = truncated(dy) * Ints(problem.width) + truncated(dx);
    return {found, load(group.pixel) + away, dx, dy};
}

}  // namespace pcbench::mvs::PCB_ISA
