// Candidates for propagation: the neighbour of least cost in each of eight regions, four nearby wedges and four lines
// further away (Xu and Tao 2019, sec. 3.1). Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "candidates.h"

namespace pcbench::mvs::PCB_ISA {

constexpr int kRegions = 8;
constexpr float kNoNeighborCost = 10.0f;  // for neighbours outside the image or not valid

struct Region {
    int count;
    int32_t dx[11], dy[11];
};

// Regions 0 to 3 are the wedges below, above, right and left, 4 to 7 the lines; all contain pixels of the other colour.
constexpr Region make_region(int number) {
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

constexpr Region kRegionOffsets[kRegions] = {make_region(0), make_region(1), make_region(2), make_region(3),
                                             make_region(4), make_region(5), make_region(6), make_region(7)};

// Copy the costs of the pixels of one colour into the packed buffer.
inline void pack_costs_by_colour(const Problem& problem, State& state, int colour) {
#pragma omp parallel for
    for (int64_t row = 0; row < problem.height + 2 * kPackedAbove; ++row) {
        float* line = state.packed_costs + row * state.packed_columns;
        for (int64_t i = 0; i < state.packed_columns; ++i) line[i] = kNoNeighborCost;
        const int64_t y = row - kPackedAbove;
        if (y < 0 || y >= problem.height) continue;
        for (int64_t x = (y + colour) & 1; x < problem.width; x += 2) {
            const int64_t at = y * problem.width + x;
            if (problem.valid == nullptr || problem.valid[at] != 0) line[kPackedLeft + x / 2] = state.cost[at];
        }
    }
}

// The best neighbour of each pixel of a group, its offset and its cost; the pixel itself if none exists or the pixel is
// not valid.
struct Neighbor {
    Mask exists;
    Ints pixel;
    Floats dx, dy, cost;
};

template <int kEvery>
inline Neighbor best_of_region(const Problem& problem, const State& state, const Group<kEvery>& group, int number) {
    const Region& steps = kRegionOffsets[number];
    Floats least = Floats(kNoNeighborCost), best = Floats(-1.0f);
    for (int k = 0; k < steps.count; ++k) {
        const int64_t row = group.y + steps.dy[k] + kPackedAbove;
        const int64_t column = ((group.first + steps.dx[k]) >> 1) + kPackedLeft;
        const Floats cost = load(state.packed_costs + row * state.packed_columns + column);
        best = select(cost < least, Floats(static_cast<float>(k)), best);
        least = lesser(cost, least);
    }
    const Mask exists = group.valid & (Floats(-0.5f) < best);
    const Ints step = truncate(greater(best, Floats(0.0f)));
    const Floats none = Floats(0.0f);
    const Floats dx = select(exists, to_floats(gather(steps.dx, step)), none);
    const Floats dy = select(exists, to_floats(gather(steps.dy, step)), none);
    const Ints away = truncate(dy) * Ints(problem.width) + truncate(dx);
    return {exists, load(group.pixel) + away, dx, dy, least};
}

}  // namespace pcbench::mvs::PCB_ISA
