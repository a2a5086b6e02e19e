// Construction of the tree: points are split at the median of the widest axis until eight remain; all leaves are full.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "common/interrupt.h"
#include "common/simd.h"
#include "points/ranks.h"
#include "points/tree.h"

namespace pcbench::PCB_ISA {

constexpr size_t kMaxBlockPoints = 64;    // blocks up to this size are sorted by counting ranks, not by partitioning
constexpr size_t kMinTaskPoints = 16384;  // smaller parts are not worth an OpenMP task

inline int widest_axis(const Item* items, size_t count) {
    // A sample is enough: the axis affects the quality of the boxes, never the results.
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

// Moves the items for which `first` is true to the front, without branches on the data, and returns their number.
template <typename First>
inline size_t partition(Item* items, size_t count, First first) {
    size_t front = 0;
    for (size_t i = 0; i < count; ++i) {
        const bool goes_first = first(items[i]);
        swap_four(items[i].p, items[front].p);
        front += goes_first;
    }
    return front;
}

// Moves the `rank` lowest items along the axis to the front.
inline void select_rank(Item* items, size_t count, size_t rank, int axis) {
    constexpr size_t kSamples = 127;
    while (rank > 0 && rank < count) {
        double sample[kSamples];
        const size_t samples = count > 4096 ? kSamples : count > 256 ? 31 : count < 8 ? count : 7;
        for (size_t s = 0; s < samples; ++s) {
            const double value = items[s * count / samples].p[axis];
            size_t at = s;
            for (; at > 0 && value < sample[at - 1]; --at) sample[at] = sample[at - 1];
            sample[at] = value;
        }
        // The pivot lies slightly beyond the rank, as seen from the shorter side, so that the shorter side remains.
        const size_t position = rank * samples / count, shift = samples > 31 ? 8 : samples > 7 ? 3 : 0;
        const double pivot = sample[2 * rank < count ? min_size(position + shift, samples - 1)
                                                     : (position > shift ? position - shift : 0)];
        size_t below = partition(items, count, [=](const Item& item) { return item.p[axis] < pivot; });
        if (below >= rank) {
            count = below;
            continue;
        }
        if (below == 0) {  // the pivot is the minimum: all items equal to it are removed, so that each round progresses
            below = partition(items, count, [=](const Item& item) { return item.p[axis] == pivot; });
            if (below >= rank) return;
        }
        items += below, count -= below, rank -= below;
    }
}

inline void write_leaf(const Item* items, size_t count, Leaf& leaf) {
    for (size_t i = 0; i < kFanout; ++i) {
        const bool real = i < count;
        leaf.x[i] = real ? items[i].p[0] : HUGE_VAL;
        leaf.y[i] = real ? items[i].p[1] : HUGE_VAL;
        leaf.z[i] = real ? items[i].p[2] : HUGE_VAL;
        leaf.row[i] = real ? items[i].p[3] : kNoRow;
    }
}

// Computes the boxes of eight leaves.
inline void compute_leaf_boxes(const Leaf* leaves, size_t count, Node& node) {
    for (size_t c = 0; c < kFanout; ++c) {
        double low[3] = {HUGE_VAL, HUGE_VAL, HUGE_VAL}, high[3] = {-HUGE_VAL, -HUGE_VAL, -HUGE_VAL};
        double first = kNoRow;
        if (c < count)
            for (size_t i = 0; i < kFanout && leaves[c].row[i] != kNoRow; ++i) {
                const double p[3] = {leaves[c].x[i], leaves[c].y[i], leaves[c].z[i]};
                for (int a = 0; a < 3; ++a) {
                    low[a] = p[a] < low[a] ? p[a] : low[a];
                    high[a] = p[a] > high[a] ? p[a] : high[a];
                }
                first = leaves[c].row[i] < first ? leaves[c].row[i] : first;
            }
        for (int a = 0; a < 3; ++a) node.low[a][c] = low[a], node.high[a][c] = high[a];
        node.first[c] = static_cast<uint32_t>(first);
    }
}

// Sorts at most kMaxBlockPoints items by counting the rank of each, with many comparisons at a time. The leaves may
// share memory with the items: they are written when the items are no longer needed.
inline void sort_block(const Item* items, size_t count, Leaf* leaves) {
    Item sorted[kMaxBlockPoints];
    if (count <= kFanout) {
        for (size_t i = 0; i < count; ++i) sorted[i] = items[i];
        return write_leaf(sorted, count, *leaves);
    }
    // Quantised coordinates are enough for a good split; the index in the lowest bits makes them distinct.
    const int axis = widest_axis(items, count);
    double low = items[0].p[axis], high = low;
    for (size_t i = 1; i < count; ++i) {
        low = items[i].p[axis] < low ? items[i].p[axis] : low;
        high = items[i].p[axis] > high ? items[i].p[axis] : high;
    }
    const double scale = high - low > 1e-290 ? (1 << 24) / (high - low) : 0.0;
    int32_t keys[kMaxBlockPoints] = {};
    for (size_t i = 0; i < count; ++i)
        keys[i] = static_cast<int32_t>((items[i].p[axis] - low) * scale) * kMaxBlockPoints + static_cast<int32_t>(i);
    for (size_t i = 0; i < count; i += kRanksPerPass) {
        int32_t rank[kRanksPerPass];
        count_ranks(keys, count, keys + i, rank);
        for (size_t c = 0; c < kRanksPerPass && i + c < count; ++c) sorted[rank[c]] = items[i + c];
    }
    const size_t left = (count + kFanout - 1) / kFanout / 2 * kFanout;
    sort_block(sorted, left, leaves);
    sort_block(sorted + left, count - left, leaves + left / kFanout);
}

// Splits at multiples of the largest full subtree, so that all leaves but the last are full. The node of a block of
// leaves is computed while the block is in the cache.
inline void sort_range(Item* items, size_t count, Node* nodes, Interrupt& interrupt) {
    while (count > kMaxBlockPoints) {
        if (count > kMinTaskPoints && interrupt.requested()) return;
        size_t unit = kMaxBlockPoints;
        while (unit * kFanout < count) unit *= kFanout;
        const size_t left = (count + unit - 1) / unit / 2 * unit;
        select_rank(items, count, left, widest_axis(items, count));
#pragma omp task if (left > kMinTaskPoints) firstprivate(items, left, nodes) shared(interrupt)
        sort_range(items, left, nodes, interrupt);
        items += left, count -= left;
        if (nodes) nodes += left / kMaxBlockPoints;
    }
    Leaf* leaves = reinterpret_cast<Leaf*>(items);
    sort_block(items, count, leaves);
    if (nodes) compute_leaf_boxes(leaves, (count + kFanout - 1) / kFanout, *nodes);
}

// Sorts points into leaves of neighbouring points, and computes their nodes unless `nodes` is null. Returns false if a
// coordinate is not finite or exceeds `limit`.
inline bool sort_into_leaves(const double* points, size_t count, double limit, Leaf* leaves, Node* nodes,
                             Interrupt& interrupt) {
    Item* items = reinterpret_cast<Item*>(leaves);
    bool valid = true;
#pragma omp parallel if (count > 2 * kMinTaskPoints)
    {
#pragma omp for schedule(static) reduction(&& : valid)
        for (size_t start = 0; start < count; start += kMinTaskPoints) {
            if (interrupt.requested()) continue;
            for (size_t i = start; i < min_size(start + kMinTaskPoints, count); ++i) {
                const double* p = points + 3 * i;
                items[i] = {{p[0], p[1], p[2], static_cast<double>(i)}};
                valid = valid && std::fabs(p[0]) <= limit && std::fabs(p[1]) <= limit && std::fabs(p[2]) <= limit;
            }
        }
#pragma omp master
        if (valid && !interrupt.stopped()) sort_range(items, count, nodes, interrupt);
    }
    return valid;
}

// Computes the boxes of eight nodes.
inline void compute_node_boxes(const Node* children, size_t count, Node& node) {
    for (size_t c = 0; c < kFanout; ++c) {
        for (int a = 0; a < 3; ++a) {
            double low = HUGE_VAL, high = -HUGE_VAL;
            for (size_t i = 0; c < count && i < kFanout; ++i) {
                low = children[c].low[a][i] < low ? children[c].low[a][i] : low;
                high = children[c].high[a][i] > high ? children[c].high[a][i] : high;
            }
            node.low[a][c] = low, node.high[a][c] = high;
        }
        node.first[c] = UINT32_MAX;
        for (size_t i = 0; c < count && i < kFanout; ++i)
            node.first[c] = children[c].first[i] < node.first[c] ? children[c].first[i] : node.first[c];
    }
}

// Computes all levels above the nodes of the leaves.
inline void build_upper_levels(Tree& tree) {
    for (size_t level = 1; level < tree.level_count; ++level) {
        Node* nodes = tree.levels[level];
        const Node* below = tree.levels[level - 1];
        const size_t count = tree.level_size[level], below_count = tree.level_size[level - 1];
        // Waking threads costs more than a few hundred nodes, and much more if the processor is shared.
#pragma omp parallel for schedule(static) if (count > 2048)
        for (size_t j = 0; j < count; ++j)
            compute_node_boxes(below + kFanout * j, min_size(kFanout, below_count - kFanout * j), nodes[j]);
    }
}

}  // namespace pcbench::PCB_ISA
