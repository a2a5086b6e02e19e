// The k nearest points of each query.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include <omp.h>

#include "common/interrupt.h"
#include "points/group_neighbors.h"
#include "points/neighbor_lists.h"

namespace pcbench::PCB_ISA {

// Lists the k nearest points of eight neighbouring queries, which are sorted together.
//
// A key is the squared distance with the number of the candidate in its last bits. A sorting network needs no branches
// and only the smaller and the larger one of two keys. Distances that differ in these bits alone are put in order
// later.
class GroupLists : public GroupNeighbors {
public:
    static constexpr size_t kMostCandidates = 1 << 12;

    // Memory for one group, one per thread and reused.
    static size_t bytes(size_t k) {
        return GroupNeighbors::bytes(k) + (k + 1) * sizeof(double[kLanes]) + capacity(k) * sizeof(double);
    }

    GroupLists(const Tree& tree, const QueryGroup& group, size_t k, double limit, double* scratch)
        : GroupNeighbors(tree, group, k, limit, scratch + (k + 1) * kLanes + capacity(k)),
          keys_(scratch),
          rows_(scratch + (k + 1) * kLanes) {}

    // Writes the results of the group, and returns the largest squared distance of a neighbour.
    double list(double* distances, int64_t* indices) {
        take_keys();
        sort_keys();
        double farthest = 0.0;
        for (int l = 0; l < group_.count; ++l) {
            const double squared = list_one(l, distances + k_ * group_.row[l], indices + k_ * group_.row[l]);
            farthest = squared > farthest ? squared : farthest;
        }
        return farthest;
    }

private:
    static constexpr uint64_t kNumberBits = kMostCandidates - 1;
    // Added to each key, so that none is denormal: threads that flush denormal numbers to zero would lose the number of
    // a candidate at distance 0.
    static constexpr uint64_t kLeastNormal = uint64_t{1} << 52;

    // Writes the keys of the selected candidates of each query. The next one overwrites one that is not selected.
    void take_keys() {
        size_t next[kLanes];
        for (int l = 0; l < kLanes; ++l) next[l] = l;
        for (size_t c = 0; c < count_; ++c) {
            const unsigned selected = bits(is_selected(c));
            if (!selected) continue;
            rows_[c] = row(c);
            for (int l = 0; l < kLanes; ++l) {
                uint64_t key;
                __builtin_memcpy(&key, squared_ + c * kLanes + l, sizeof key);
                key = ((key & ~kNumberBits) | c) + kLeastNormal;
                __builtin_memcpy(keys_ + next[l], &key, sizeof key);
                next[l] += (selected >> l & 1) * kLanes;
            }
        }
    }

    // Merge exchange (Batcher 1968; Knuth, The Art of Computer Programming 3, algorithm 5.2.2 M).
    void sort_keys() {
        size_t largest = 1;
        while (2 * largest < k_) largest *= 2;
        for (size_t p = largest; p > 0; p /= 2)
            for (size_t q = largest, offset = 0, apart = p;; offset = p, apart = q - p, q /= 2) {
                for (size_t i = 0; i + apart < k_; ++i) {
                    if ((i & p) != offset) continue;
                    double *const first = keys_ + i * kLanes, *const second = first + apart * kLanes;
                    const Vector a = load(first), b = load(second);
                    store(first, min(a, b)), store(second, max(a, b));
                }
                if (q == p) break;
            }
    }

    // Writes the neighbours of one query, and returns the largest squared distance.
    double list_one(int lane, double* distances, int64_t* indices) const {
        bool is_sorted = true;
        double before = -1.0, row_before = 0.0;
        for (size_t i = 0; i < k_; ++i) {
            uint64_t key;
            __builtin_memcpy(&key, keys_ + i * kLanes + lane, sizeof key);
            const double s = squared_[(key & kNumberBits) * kLanes + lane], r = rows_[key & kNumberBits];
            is_sorted &= is_before(before, row_before, s, r);
            distances[i] = before = s, row_before = r;
            indices[i] = static_cast<int64_t>(r);
        }
        if (!is_sorted) insertion_sort(distances, indices);
        const double farthest = distances[k_ - 1];
        size_t i = 0;
        for (; i + kLanes <= k_; i += kLanes) store(distances + i, sqrt(load(distances + i)));
        for (; i < k_; ++i) distances[i] = std::sqrt(distances[i]);
        return farthest;
    }

    void insertion_sort(double* squared, int64_t* rows) const {
        for (size_t i = 1; i < k_; ++i) {
            const double s = squared[i];
            const int64_t r = rows[i];
            size_t at = i;
            for (; at > 0 && (s < squared[at - 1] || (s == squared[at - 1] && r < rows[at - 1])); --at)
                squared[at] = squared[at - 1], rows[at] = rows[at - 1];
            squared[at] = s, rows[at] = r;
        }
    }

    double* keys_;  // [neighbour][query]
    double* rows_;  // of the candidates
};

// Numbers of neighbours, measured on cities, volumes and clusters: fewest for which groups and buffers are faster than
// sorted lists, and fewest for which the candidates of a group no longer fit into the cache.
constexpr size_t kFewestInGroups = 8, kFewestInBuffer = 20, kTooManyForGroups = 300;
static_assert(GroupNeighbors::capacity(kTooManyForGroups) <= GroupLists::kMostCandidates);

// Memory of one thread.
inline size_t knearest_bytes(size_t k) {
    return NeighborBuffer::bytes(NearestMany::capacity(k)) + (k < kTooManyForGroups ? GroupLists::bytes(k) : 0);
}

// `scratch` is memory of knearest_bytes(k) for each thread.
inline void knearest(const Tree& tree, const Leaf* queries, size_t leaf_count, size_t k, double* distances,
                     int64_t* indices, double* const* scratch, Interrupt& interrupt) {
    const bool by_group = kFewestInGroups <= k && k < kTooManyForGroups && are_close(leaf_count, tree);
#pragma omp parallel
    {
        double* memory = scratch[omp_get_thread_num()];
        NeighborBuffer buffer(NearestMany::capacity(k), memory);
        double* group_memory = memory + NeighborBuffer::bytes(NearestMany::capacity(k)) / sizeof(double);
        SearchLimit limit;
        const auto search_group = [&](const Leaf& leaf) {
            const QueryGroup group(leaf);
            for (bool complete = false; !complete;) {
                GroupLists search(tree, group, k, limit.of(group.box), group_memory);
                traverse(tree, search);
                complete = search.select_neighbors();
                limit.update(group.box, complete ? search.list(distances, indices) : 0.0);
            }
        };
        const auto search_one = [&](const double* query, size_t row) {
            const Box box = box_of_point(query);
            for (bool complete = false; !complete;) {
                NearestMany search(tree, query, k, limit.of(box), buffer);
                traverse(tree, search);
                complete = buffer.count() >= k;
                if (complete) {
                    buffer.sort();
                    buffer.write(k, distances + k * row, indices + k * row);
                }
                limit.update(box, complete ? buffer.squared(k - 1) : 0.0);
            }
        };
        const auto search_few = [&](const double* query, size_t row) {
            NearestK search(tree, query, k, distances + k * row, indices + k * row);
            traverse(tree, search);
            for (size_t j = 0; j < k; ++j) distances[k * row + j] = std::sqrt(distances[k * row + j]);
        };
#pragma omp for schedule(dynamic, 16)
        for (size_t q = 0; q < leaf_count; ++q) {
            if (interrupt.requested()) continue;
            const Leaf& leaf = queries[q];
            if (by_group) {
                search_group(leaf);
                continue;
            }
            for (size_t l = 0; l < kFanout && leaf.row[l] != kNoRow; ++l) {
                const double query[3] = {leaf.x[l], leaf.y[l], leaf.z[l]};
                const size_t row = static_cast<size_t>(leaf.row[l]);
                k < kFewestInBuffer ? search_few(query, row) : search_one(query, row);
            }
        }
    }
}

}  // namespace pcbench::PCB_ISA
