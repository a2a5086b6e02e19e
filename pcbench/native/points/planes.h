// Planes through the k nearest points of points of the tree, eight neighbouring queries at a time.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include <omp.h>

#include "common/eigen.h"
#include "common/interrupt.h"
#include "points/group_neighbors.h"
#include "points/ranks.h"

namespace pcbench::PCB_ISA {

class GroupPlanes : public GroupNeighbors {
public:
    // Memory for one group, one per thread and reused.
    static size_t bytes(size_t k) {
        return GroupNeighbors::bytes(k) + capacity(k) * sizeof(uint32_t[2]) + sizeof(int32_t[kRanksPerPass]);
    }

    GroupPlanes(const Tree& tree, const QueryGroup& group, size_t k, double limit, double* scratch)
        : GroupNeighbors(tree, group, k, limit, scratch),
          order_(listed_ + capacity_),
          keys_(reinterpret_cast<int32_t*>(order_ + capacity_)) {}

    // Writes the results of the group, and returns the largest squared distance of a neighbour. The neighbours of a
    // query are summed in the order of their rows, whatever the tree and the other queries of the group. A candidate
    // that is not a neighbour adds zero, which changes no bit.
    double fit(double* normals, double* variation, double* distances, int64_t* indices, double* reach) {
        const Vector x = load(group_.x), y = load(group_.y), z = load(group_.z), zero = splat(0.0);
        Vector sx = zero, sy = zero, sz = zero, xx = zero, xy = zero, xz = zero, yy = zero, yz = zero, zz = zero;
        alignas(64) double own_row[kLanes];
        for (int l = 0; l < kLanes; ++l) own_row[l] = static_cast<double>(group_.point[l]);
        Vector nearest = splat(HUGE_VAL), nearest_row = splat(kNoRow), farthest = zero;
        const size_t listed_count = sort_by_row();
        for (size_t position = 0; position < listed_count; ++position) {
            const size_t c = order_[position], i = slots_[c] % kFanout;
            const Leaf& leaf = tree_.leaves[slots_[c] / kFanout];
            const Mask selected = is_selected(c);
            // Differences to the query, which is one of the points: large coordinates lose no precision.
            const Vector dx = select(selected, splat(leaf.x[i]) - x, zero);
            const Vector dy = select(selected, splat(leaf.y[i]) - y, zero);
            const Vector dz = select(selected, splat(leaf.z[i]) - z, zero);
            sx = sx + dx, sy = sy + dy, sz = sz + dz;
            xx = xx + dx * dx, xy = xy + dx * dy, xz = xz + dx * dz;
            yy = yy + dy * dy, yz = yz + dy * dz, zz = zz + dz * dz;
            const Vector candidate = splat(leaf.row[i]);
            const Vector other = select(candidate == load(own_row), splat(HUGE_VAL), squared(c));
            nearest_row = select(other < nearest, candidate, nearest_row);
            nearest = min(nearest, other);
            farthest = max(farthest, select(selected, squared(c), zero));
        }
        const Vector share = splat(1.0 / static_cast<double>(k_));
        Symmetric<Vector> covariance{xx - sx * sx * share, xy - sx * sy * share, xz - sx * sz * share,
                                     yy - sy * sy * share, yz - sy * sz * share, zz - sz * sz * share};
        const SmallestEigen smallest = smallest_eigen(covariance);
        // Orient upwards: z > 0; if z is 0, y > 0; if both are 0, x > 0.
        const Mask down = (smallest.z < zero) |
                          ((smallest.z == zero) & ((smallest.y < zero) | ((smallest.y == zero) & (smallest.x < zero))));
        alignas(64) double out[7][kLanes];
        store(out[0], select(down, zero - smallest.x, smallest.x));
        store(out[1], select(down, zero - smallest.y, smallest.y));
        store(out[2], select(down, zero - smallest.z, smallest.z));
        store(out[3], smallest.share), store(out[4], sqrt(nearest)), store(out[5], nearest_row);
        store(out[6], sqrt(farthest));
        for (int l = 0; l < group_.count; ++l) {
            const size_t row = group_.row[l];
            for (int a = 0; a < 3; ++a) normals[3 * row + a] = out[a][l];
            variation[row] = out[3][l];
            distances[row] = out[4][l];
            indices[row] = static_cast<int64_t>(out[5][l]);
            reach[row] = out[6][l];
        }
        return max_lane(farthest);
    }

private:
    // Writes the candidates that any query has selected to `order_`, sorted by row, and returns their number.
    size_t sort_by_row() {
        size_t count = 0;
        for (size_t c = 0; c < count_; ++c) {
            keys_[count] = static_cast<int32_t>(static_cast<int64_t>(row(c)) - (int64_t{1} << 31));
            listed_[count] = static_cast<uint32_t>(c);
            count += bits(is_selected(c)) != 0;
        }
        for (size_t i = 0; i < count; i += kRanksPerPass) {
            int32_t rank[kRanksPerPass];
            count_ranks(keys_, count, keys_ + i, rank);
            for (size_t j = 0; j < kRanksPerPass && i + j < count; ++j) order_[rank[j]] = listed_[i + j];
        }
        return count;
    }

    uint32_t* order_;  // candidates by row
    int32_t* keys_;    // rows of the listed candidates, shifted into the range of the type
};

// Queries are points of the tree, sorted into leaves. `rows` maps them to points; null means that rows are points.
inline void planes(const Tree& tree, const Leaf* queries, size_t leaf_count, const int64_t* rows, size_t k,
                   double* normals, double* variation, double* distances, int64_t* indices, double* reach,
                   double* const* scratch, Interrupt& interrupt) {
    const size_t group_size = are_close(leaf_count, tree) ? kFanout : 1;
#pragma omp parallel
    {
        SearchLimit limit;
#pragma omp for schedule(dynamic, 64)
        for (size_t q = 0; q < leaf_count; ++q) {
            if (q % 16 == 0 && interrupt.requested()) continue;
            for (size_t first = 0; first < kFanout && queries[q].row[first] != kNoRow; first += group_size) {
                QueryGroup group(queries[q], first, group_size);
                // The rows are scattered over the results: prefetch them during the traversal.
                for (size_t row : group.row) {
                    __builtin_prefetch(normals + 3 * row, 1), __builtin_prefetch(variation + row, 1);
                    __builtin_prefetch(distances + row, 1), __builtin_prefetch(indices + row, 1);
                    __builtin_prefetch(reach + row, 1);
                }
                if (rows)
                    for (size_t& point : group.point) point = static_cast<size_t>(rows[point]);
                for (bool complete = false; !complete;) {
                    GroupPlanes planes_of_group(tree, group, k, limit.of(group.box), scratch[omp_get_thread_num()]);
                    traverse(tree, planes_of_group);
                    complete = planes_of_group.select_neighbors();
                    const double farthest =
                        complete ? planes_of_group.fit(normals, variation, distances, indices, reach) : 0.0;
                    limit.update(group.box, farthest);
                }
            }
        }
    }
}

}  // namespace pcbench::PCB_ISA
