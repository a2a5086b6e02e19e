// The k nearest points of each query.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include <omp.h>

#include "common/interrupt.h"
#include "points/group_neighbors.h"
#include "points/neighbor_lists.h"

namespace pcbench::PCB_ISA {

// Lists the k nearest points of eight neighbouring queries.
class GroupLists : public GroupNeighbors {
public:
    // Memory for one group, one per thread and reused.
    static size_t bytes(size_t k) { return GroupNeighbors::bytes(k) + capacity(k) * sizeof(double); }

    GroupLists(const Tree& tree, const QueryGroup& group, size_t k, double limit, double* scratch)
        : GroupNeighbors(tree, group, k, limit, scratch + capacity(k)), rows_(scratch) {}

    // Writes the results of the group, and returns the largest squared distance of a neighbour.
    double list(NeighborBuffer& buffer, double* distances, int64_t* indices) {
        double farthest = 0.0;
        for (size_t c = 0; c < count_; ++c) rows_[c] = row(c), listed_[c] = bits(is_selected(c));
        for (int l = 0; l < group_.count; ++l) {
            buffer.clear();
            for (size_t c = 0; c < count_; ++c) buffer.append(squared_[c * kLanes + l], rows_[c], listed_[c] >> l & 1);
            buffer.sort();
            buffer.write(k_, distances + k_ * group_.row[l], indices + k_ * group_.row[l]);
            farthest = buffer.squared(k_ - 1) > farthest ? buffer.squared(k_ - 1) : farthest;
        }
        return farthest;
    }

private:
    double* rows_;  // of the candidates
};

// Numbers of neighbours, measured on cities, volumes and clusters: fewest for which groups and buffers are faster than
// sorted lists, and fewest for which the candidates of a group no longer fit into the cache.
constexpr size_t kFewestInGroups = 8, kFewestInBuffer = 20, kTooManyForGroups = 300;

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
                limit.update(group.box, complete ? search.list(buffer, distances, indices) : 0.0);
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
