// Building the tree: points are halved at the median of their widest axis until eight are left, all leaves full.
// Included once for each instruction set, see kernels_isa.h.
#pragma once
#include <algorithm>
#include <cstring>

#include "interrupt.h"
#include "lanes.h"
#include "tree.h"

namespace pcbench::PCB_ISA {

constexpr size_t kBlock = 64;     // up to here ranks are counted instead of partitioning
constexpr size_t kTask = 16384;   // smaller parts are not worth a task

struct Key {
    double value;
    uint64_t index;
    bool operator<(const Key& other) const {
        return value < other.value || (value == other.value && index < other.index);
    }
};

inline int widest_axis(const Item* items, size_t count) {
    // A sample is enough: the axis decides how good the boxes are, never what is found.
    const size_t step = count > 256 ? count / 128 : 1;
    double low[3], high[3];
    for (int a = 0; a < 3; ++a) low[a] = high[a] = items[0].p[a];
    for (size_t i = step; i < count; i += step)
        for (int a = 0; a < 3; ++a) {
            const double v = items[i].p[a];
            low[a] = v < low[a] ? v : low[a];
            high[a] = v > high[a] ? v : high[a];
        }
    const double x = high[0] - low[0], y = high[1] - low[1], z = high[2] - low[2];
    return x >= y ? (x >= z ? 0 : 2) : (y >= z ? 1 : 2);
}

// Moves the items below the pivot to the front without a branch on the data; returns how many.
inline size_t partition(Item* items, size_t count, int axis, Key pivot) {
    size_t below = 0;
    for (size_t i = 0; i < count; ++i) {
        const Item item = items[i];
        const double v = item.p[axis];
        const bool less = (v < pivot.value) | ((v == pivot.value) & (item.index < pivot.index));
        items[i] = items[below];
        items[below] = item;
        below += less;
    }
    return below;
}

// The `rank` lowest items along the axis come first. Ties fall by row, so equal coordinates cannot spoil the halving.
inline void select(Item* items, size_t count, size_t rank, int axis) {
    constexpr size_t kSamples = 255;
    while (rank > 0 && rank < count) {
        Key sample[kSamples];
        const size_t samples = count > 4096 ? kSamples : count > 256 ? 31 : count < 8 ? count : 7;
        for (size_t s = 0; s < samples; ++s) {
            const Item& item = items[s * count / samples];
            sample[s] = {item.p[axis], item.index};
        }
        std::sort(sample, sample + samples);
        // A little beyond the wanted rank, seen from the shorter side: that side, with the rank in it, is what remains.
        const size_t position = rank * samples / count, shift = samples > 31 ? 12 : samples > 7 ? 3 : 0;
        const size_t at = 2 * rank < count ? std::min(position + shift, samples - 1)
                                           : (position > shift ? position - shift : 0);
        size_t below = partition(items, count, axis, sample[at]);
        if (below >= rank) {
            count = below;
            continue;
        }
        if (below == 0) {  // the pivot is the lowest: set it aside, so that each round removes something
            size_t lowest = 0;
            while (items[lowest].index != sample[at].index) ++lowest;
            std::swap(items[0], items[lowest]);
            below = 1;
        }
        items += below, count -= below, rank -= below;
    }
}

inline void write_leaf(const Item* items, size_t count, Leaf& leaf) {
    for (size_t i = 0; i < kFan; ++i) {
        const bool real = i < count;
        leaf.x[i] = real ? items[i].p[0] : HUGE_VAL;
        leaf.y[i] = real ? items[i].p[1] : HUGE_VAL;
        leaf.z[i] = real ? items[i].p[2] : HUGE_VAL;
        leaf.index[i] = real ? static_cast<uint32_t>(items[i].index) : kNoPoint;
    }
}

// At most kBlock items: each one's rank is counted, eight comparisons at a time.
inline void arrange_block(Item* items, size_t count, Leaf* leaves) {
    if (count <= kFan) return write_leaf(items, count, *leaves);
    const int axis = widest_axis(items, count);
    alignas(64) double keys[kBlock];
    for (size_t i = 0; i < kBlock; ++i) {
        // The row number in the lowest bits makes the keys distinct; it may disturb the order by as much, no more.
        double key = i < count ? items[i].p[axis] : HUGE_VAL;
        uint64_t raw;
        std::memcpy(&raw, &key, sizeof raw);
        if (i < count) raw = (raw & ~uint64_t{kBlock - 1}) | i;
        std::memcpy(&keys[i], &raw, sizeof raw);
    }
    Item sorted[kBlock];
    for (size_t i = 0; i < count; ++i) {
        const Lanes own = splat(keys[i]);
        unsigned rank = 0;
        for (size_t j = 0; j < count; j += kLanes) rank += __builtin_popcount(bits(load(keys + j) < own));
        sorted[rank] = items[i];
    }
    const size_t left = (count + kFan - 1) / kFan / 2 * kFan;
    arrange_block(sorted, left, leaves);
    arrange_block(sorted + left, count - left, leaves + left / kFan);
}

// Halves are whole multiples of the largest full subtree, so that all leaves but the last are full.
inline void arrange_part(Item* items, size_t count, Leaf* leaves, Interrupt& interrupt) {
    while (count > kBlock) {
        if (count > kTask && interrupt.requested()) return;
        size_t unit = kBlock;
        while (unit * kFan < count) unit *= kFan;
        const size_t left = (count + unit - 1) / unit / 2 * unit;
        select(items, count, left, widest_axis(items, count));
#pragma omp task if (left > kTask) firstprivate(items, left, leaves) shared(interrupt)
        arrange_part(items, left, leaves, interrupt);
        items += left, count -= left, leaves += left / kFan;
    }
    arrange_block(items, count, leaves);
}

// Sorts points into leaves that are near each other in space. False when a coordinate is not finite or above `limit`.
inline bool arrange(const double* points, size_t count, double limit, Item* items, Leaf* leaves,
                    Interrupt& interrupt) {
    bool valid = true;
#pragma omp parallel
    {
#pragma omp for schedule(static) reduction(&& : valid)
        for (size_t i = 0; i < count; ++i) {
            const double* p = points + 3 * i;
            items[i] = {{p[0], p[1], p[2]}, i};
            valid = valid && std::fabs(p[0]) <= limit && std::fabs(p[1]) <= limit && std::fabs(p[2]) <= limit;
        }
#pragma omp master
        if (valid) arrange_part(items, count, leaves, interrupt);
    }
    return valid;
}

// The boxes of eight leaves.
inline void bound_leaves(const Leaf* leaves, size_t count, Node& node) {
    for (size_t c = 0; c < kFan; ++c) {
        double low[3] = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, high[3] = {-HUGE_VAL, -HUGE_VAL, -HUGE_VAL};
        uint32_t first = kNoPoint;
        if (c < count)
            for (size_t i = 0; i < kFan && leaves[c].index[i] != kNoPoint; ++i) {
                const double p[3] = {leaves[c].x[i], leaves[c].y[i], leaves[c].z[i]};
                for (int a = 0; a < 3; ++a) {
                    low[a] = p[a] < low[a] ? p[a] : low[a];
                    high[a] = p[a] > high[a] ? p[a] : high[a];
                }
                first = leaves[c].index[i] < first ? leaves[c].index[i] : first;
            }
        for (int a = 0; a < 3; ++a) node.low[a][c] = low[a], node.high[a][c] = high[a];
        node.first[c] = first;
    }
}

// The boxes of eight nodes.
inline void bound_nodes(const Node* children, size_t count, Node& node) {
    for (size_t c = 0; c < kFan; ++c) {
        for (int a = 0; a < 3; ++a) {
            double low = HUGE_VAL, high = -HUGE_VAL;
            for (size_t i = 0; c < count && i < kFan; ++i) {
                low = children[c].low[a][i] < low ? children[c].low[a][i] : low;
                high = children[c].high[a][i] > high ? children[c].high[a][i] : high;
            }
            node.low[a][c] = low, node.high[a][c] = high;
        }
        node.first[c] = kNoPoint;
        for (size_t i = 0; c < count && i < kFan; ++i)
            node.first[c] = children[c].first[i] < node.first[c] ? children[c].first[i] : node.first[c];
    }
}

inline void bound(Tree& tree) {
    for (size_t level = 0; level < tree.level_count; ++level) {
        Node* nodes = tree.levels[level];
        const size_t count = tree.level_size[level];
        const size_t below = level == 0 ? tree.leaf_count : tree.level_size[level - 1];
#pragma omp parallel for schedule(static) if (count > 64)
        for (size_t j = 0; j < count; ++j) {
            const size_t children = std::min(kFan, below - kFan * j);
            if (level == 0)
                bound_leaves(tree.leaves + kFan * j, children, nodes[j]);
            else
                bound_nodes(tree.levels[level - 1] + kFan * j, children, nodes[j]);
        }
    }
}

}  // namespace pcbench::PCB_ISA
