// Traversal of the leaves near a query, nearest first, as long as they can change the result.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "common/simd.h"
#include "points/tree.h"

namespace pcbench::PCB_ISA {

// Greater than any squared distance (coordinates are at most 1e100), and less than the infinity of empty slots.
constexpr double kUnbounded = 1e300;

struct Box {
    double low[3], high[3];
};

inline Box box_of_point(const double* p) { return {{p[0], p[1], p[2]}, {p[0], p[1], p[2]}}; }

inline Vector interval_gap(Vector low, Vector high, Vector other_low, Vector other_high) {
    return max(max(other_low - high, low - other_high), splat(0.0));
}

// Squared distance between the box and each child of the node. Rounding is monotone, so no computed squared distance
// between points inside them is smaller.
inline Vector squared_gaps(const Node& node, const Box& box) {
    Vector gap[3];
    for (int a = 0; a < 3; ++a)
        gap[a] = interval_gap(splat(box.low[a]), splat(box.high[a]), load(node.low[a]), load(node.high[a]));
    return squared_length(gap[0], gap[1], gap[2]);
}

inline void prefetch(const Leaf& leaf) {
    __builtin_prefetch(leaf.x), __builtin_prefetch(leaf.y), __builtin_prefetch(leaf.z), __builtin_prefetch(leaf.row);
}

// Visitor: squared_gaps(node) returns, for each child, a lower bound of the squared distances of its points; bound()
// returns the squared distance beyond which points do not matter; last_tie() returns the highest row at exactly that
// distance that can still be replaced; leaf(id, parent, child) visits a leaf.
template <typename Visitor>
inline void traverse(const Tree& tree, Visitor& visitor) {
    struct Entry {
        double gap;
        uint32_t node, level;
    };
    Entry stack[kFanout * kMaxLevels];
    size_t depth = 0;
    stack[depth++] = {0.0, 0, static_cast<uint32_t>(tree.level_count - 1)};
    while (depth > 0) {
        const Entry entry = stack[--depth];
        double bound = visitor.bound();
        if (entry.gap > bound) continue;
        const Node& node = tree.levels[entry.level][entry.node];
        const Vector gap = visitor.squared_gaps(node);
        unsigned pending = bits(gap <= splat(bound));
        for (unsigned equal = bits(gap == splat(bound)) & pending; equal; equal &= equal - 1)
            if (node.first[__builtin_ctz(equal)] > visitor.last_tie()) pending &= ~(equal & -equal);
        alignas(64) double distance[kLanes];
        store(distance, gap);
        const auto nearest = [&] {
            int best = __builtin_ctz(pending);
            for (unsigned rest = pending & (pending - 1); rest; rest &= rest - 1)
                if (distance[__builtin_ctz(rest)] < distance[best]) best = __builtin_ctz(rest);
            return best;
        };
        if (entry.level == 0) {
            for (unsigned rest = pending; rest; rest &= rest - 1)
                prefetch(tree.leaves[kFanout * entry.node + __builtin_ctz(rest)]);
            for (; pending; bound = visitor.bound()) {
                const int child = nearest();
                pending &= ~(1u << child);
                if (distance[child] > bound) break;
                visitor.leaf(kFanout * entry.node + child, node, child);
            }
        } else if (pending) {
            const int first = nearest();
            for (unsigned rest = pending & ~(1u << first); rest; rest &= rest - 1) {
                const uint32_t child = __builtin_ctz(rest);
                stack[depth++] = {distance[child], static_cast<uint32_t>(kFanout * entry.node + child),
                                  entry.level - 1};
            }
            stack[depth++] = {distance[first], static_cast<uint32_t>(kFanout * entry.node + first), entry.level - 1};
        }
    }
}

}  // namespace pcbench::PCB_ISA
