// Visiting the leaves near a query, nearest first, as long as they can change an answer.
// Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "common/simd.h"
#include "points/tree.h"

namespace pcbench::PCB_ISA {

// More than any squared distance (coordinates are checked to stay below 1e100), less than the infinity of empty slots.
constexpr double kFarAway = 1e300;

struct Box {
    double low[3], high[3];
};

inline Box point_box(const double* p) { return {{p[0], p[1], p[2]}, {p[0], p[1], p[2]}}; }

inline Vector axis_gap(Vector low, Vector high, Vector other_low, Vector other_high) {
    return max(max(other_low - high, low - other_high), splat(0.0));
}

// Squared distance between the box and each of the node's children; rounding is monotone, so no squared distance
// computed between points inside them is lower.
inline Vector gaps(const Node& node, const Box& box) {
    Vector gap[3];
    for (int a = 0; a < 3; ++a)
        gap[a] = axis_gap(splat(box.low[a]), splat(box.high[a]), load(node.low[a]), load(node.high[a]));
    return squared_length(gap[0], gap[1], gap[2]);
}

inline void prefetch(const Leaf& leaf) {
    __builtin_prefetch(leaf.x), __builtin_prefetch(leaf.y), __builtin_prefetch(leaf.z), __builtin_prefetch(leaf.row);
}

// Visitor: gaps(node), for each child a squared distance that no point inside goes below; bound(), the squared distance
// above which nothing matters; last_tie(), the highest row at that very distance that may still be beaten; leaf(id,
// parent, child).
template <typename Visitor>
inline void walk(const Tree& tree, Visitor& visitor) {
    struct Entry {
        double gap;
        uint32_t node, level;
    };
    Entry stack[kFan * kMaxLevels];
    size_t depth = 0;
    stack[depth++] = {0.0, 0, static_cast<uint32_t>(tree.level_count - 1)};
    while (depth > 0) {
        const Entry entry = stack[--depth];
        double bound = visitor.bound();
        if (entry.gap > bound) continue;
        const Node& node = tree.levels[entry.level][entry.node];
        const Vector gap = visitor.gaps(node);
        unsigned open = bits(gap <= splat(bound));
        for (unsigned equal = bits(gap == splat(bound)) & open; equal; equal &= equal - 1)
            if (node.first[__builtin_ctz(equal)] > visitor.last_tie()) open &= ~(equal & -equal);
        alignas(64) double distance[kLanes];
        store(distance, gap);
        const auto nearest = [&] {
            int best = __builtin_ctz(open);
            for (unsigned rest = open & (open - 1); rest; rest &= rest - 1)
                if (distance[__builtin_ctz(rest)] < distance[best]) best = __builtin_ctz(rest);
            return best;
        };
        if (entry.level == 0) {
            for (unsigned rest = open; rest; rest &= rest - 1)
                prefetch(tree.leaves[kFan * entry.node + __builtin_ctz(rest)]);
            for (; open; bound = visitor.bound()) {
                const int child = nearest();
                open &= ~(1u << child);
                if (distance[child] > bound) break;
                visitor.leaf(kFan * entry.node + child, node, child);
            }
        } else if (open) {
            const int first = nearest();
            for (unsigned rest = open & ~(1u << first); rest; rest &= rest - 1) {
                const uint32_t child = __builtin_ctz(rest);
                stack[depth++] = {distance[child], static_cast<uint32_t>(kFan * entry.node + child), entry.level - 1};
            }
            stack[depth++] = {distance[first], static_cast<uint32_t>(kFan * entry.node + first), entry.level - 1};
        }
    }
}

}  // namespace pcbench::PCB_ISA
