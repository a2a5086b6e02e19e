// Planes through the k nearest points of points of the tree, eight neighbouring queries at a time. The neighbours are
// not listed: each query only determines the distance that separates its k nearest points from the rest.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include <omp.h>

#include "common/eigen.h"
#include "common/interrupt.h"
#include "points/group.h"

namespace pcbench::PCB_ISA {

// Memory for the candidates of one group, one per thread and reused.
struct PlaneScratch {
    // After tightening, at most k points remain for each query.
    static size_t points(size_t k) { return kLanes * k + 8 * kFanout * kFanout; }
    static size_t bytes(size_t k) { return points(k) * (sizeof(double[kLanes]) + 2 * sizeof(uint64_t)); }
};

// Shell sort with Knuth's gaps. Replaces std::sort, of which the linker would keep one copy for all instruction sets.
inline void sort_ascending(uint64_t* keys, size_t count) {
    size_t gap = 1;
    while (gap < count / 9) gap = 3 * gap + 1;
    for (; gap > 0; gap /= 3)
        for (size_t i = gap; i < count; ++i) {
            const uint64_t key = keys[i];
            size_t at = i;
            for (; at >= gap && key < keys[at - gap]; at -= gap) keys[at] = keys[at - gap];
            keys[at] = key;
        }
}

class GroupPlanes {
public:
    GroupPlanes(const Tree& tree, const QueryGroup& group, size_t k, double* scratch)
        : tree_(tree),
          group_(group),
          k_(k),
          capacity_(PlaneScratch::points(k)),
          first_tightening_(2 * k + 4 * kFanout),
          squared_(scratch),
          slots_(reinterpret_cast<uint64_t*>(scratch + capacity_ * kLanes)),
          order_(slots_ + capacity_) {
        store(limit_, splat(kUnbounded));
        store(last_row_, splat(kNoRow));
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, group_.box); }
    double bound() const { return bound_; }
    uint32_t last_tie() const { return bound_ == 0.0 ? static_cast<uint32_t>(max_lane(load(last_row_))) : UINT32_MAX; }

    void leaf(uint32_t id, const Node& parent, int child) {
        if (!bits(group_.squared_gaps_to(parent, child) <= load(limit_))) return;
        if (count_ + kFanout > capacity_) tighten(0);
        const Leaf& leaf = tree_.leaves[id];
        const Vector x = load(group_.x), y = load(group_.y), z = load(group_.z), limit = load(limit_);
        for (size_t i = 0; i < kFanout; ++i) {
            const Vector squared = squared_length(x - splat(leaf.x[i]), y - splat(leaf.y[i]), z - splat(leaf.z[i]));
            store(squared_ + count_ * kLanes, squared);
            slots_[count_] = kFanout * id + i;
            count_ += bits(squared <= limit) != 0;
        }
        if (first_tightening_ <= count_ && bound_ == kUnbounded) tighten(k_ / 4);
    }

    // Writes the results of the group. The neighbours of a query are summed in the order of their rows, whatever the
    // tree and the other queries of the group. A candidate that is not a neighbour adds zero, which changes no bit.
    void fit(double* normals, double* variation, double* distances, int64_t* indices, double* reach) {
        tighten(0);
        const Vector x = load(group_.x), y = load(group_.y), z = load(group_.z), zero = splat(0.0);
        Vector sx = zero, sy = zero, sz = zero, xx = zero, xy = zero, xz = zero, yy = zero, yz = zero, zz = zero;
        alignas(64) double own_row[kLanes];
        for (int l = 0; l < kLanes; ++l) own_row[l] = static_cast<double>(group_.point[l]);
        Vector nearest = splat(HUGE_VAL), nearest_row = splat(kNoRow);
        sort_by_row();
        for (size_t position = 0; position < count_; ++position) {
            const size_t c = order_[position] & kMaxCandidate, i = slots_[c] % kFanout;
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
            // `nearest` may be the query itself, at infinity, until another point replaces it (k >= 2).
            const Mask better = (other < nearest) | ((other == nearest) & (candidate < nearest_row));
            nearest = min(nearest, other);
            nearest_row = select(better, candidate, nearest_row);
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
        store(out[6], sqrt(load(limit_)));
        for (int l = 0; l < group_.count; ++l) {
            const size_t row = group_.row[l];
            for (int a = 0; a < 3; ++a) normals[3 * row + a] = out[a][l];
            variation[row] = out[3][l];
            distances[row] = out[4][l];
            indices[row] = static_cast<int64_t>(out[5][l]);
            reach[row] = out[6][l];
        }
    }

private:
    Vector squared(size_t c) const { return load(squared_ + c * kLanes); }
    double row(size_t c) const { return tree_.leaves[slots_[c] / kFanout].row[slots_[c] % kFanout]; }

    Mask is_selected(size_t c) const {
        const Vector limit = load(limit_);
        return (squared(c) < limit) | ((squared(c) == limit) & (splat(row(c)) <= load(last_row_)));
    }

    Vector count_up_to(Vector limit) const {
        const Vector zero = splat(0.0), one = splat(1.0);
        Vector count[4] = {zero, zero, zero, zero};  // four independent sums hide the latency of additions
        size_t c = 0;
        for (; c + 4 <= count_; c += 4)
            for (size_t i = 0; i < 4; ++i) count[i] = count[i] + select(squared(c + i) <= limit, one, zero);
        for (; c < count_; ++c) count[0] = count[0] + select(squared(c) <= limit, one, zero);
        return (count[0] + count[1]) + (count[2] + count[3]);
    }

    // Lowers each query's limit until it contains k to k + surplus candidates. On a surface their number is about
    // linear in the squared distance, so interpolation takes few rounds. Ties are resolved one query at a time.
    void tighten(size_t surplus) {
        const Vector k = splat(static_cast<double>(k_)), max_within = splat(static_cast<double>(k_ + surplus));
        // `low` contains too few candidates, unless it is the result already; `high` contains enough.
        const Vector zero = splat(0.0), one = splat(1.0), limit = load(limit_);
        Vector low = zero, below = zero, high = zero, within = zero;
        for (size_t c = 0; c < count_; ++c) {
            const Mask inside = squared(c) <= limit;
            below = below + select(squared(c) <= zero, one, zero);
            within = within + select(inside, one, zero);
            high = max(high, select(inside, squared(c), zero));
        }
        const Mask at_zero = k <= below;
        high = select(at_zero, low, high), within = select(at_zero, below, within);
        for (int round = 0; round < 9 && bits(within <= max_within) != 0xff; ++round) {
            const Vector target = splat(static_cast<double>(k_) + 0.5 * static_cast<double>(surplus + 1));
            Vector share = (target - below) / (within - below + splat(1.0));
            if (round % 3 == 2) share = splat(0.5);
            const Vector middle = select(within <= max_within, high, low + (high - low) * share);
            const Vector count = count_up_to(middle);
            const Mask over = k <= count;
            high = select(over, middle, high), within = select(over, count, within);
            low = select(over, low, middle), below = select(over, below, count);
        }
        store(limit_, high);
        store(last_row_, splat(kNoRow));
        bound_ = max_lane(load(limit_));
        // At distance 0, points with higher rows than the k-th are skipped: many duplicates would cost quadratic time.
        unsigned tied = surplus == 0 ? ~bits(within <= max_within) & 0xff : 0;
        if (bound_ == 0.0) tied = 0xff;
        for (; tied; tied &= tied - 1) resolve_ties(__builtin_ctz(tied));
        drop_unselected();
    }

    // Sets the limit of one query to its k-th candidate by (distance, row).
    void resolve_ties(int lane) {
        double last = -1.0, last_row = -1.0;
        for (size_t rank = 0; rank < k_; ++rank) {
            double next = HUGE_VAL, next_row = kNoRow;
            for (size_t c = 0; c < count_; ++c) {
                const double s = squared_[c * kLanes + lane], r = row(c);
                if (is_before(last, last_row, s, r) && is_before(s, r, next, next_row)) next = s, next_row = r;
            }
            last = next, last_row = next_row;
        }
        limit_[lane] = last, last_row_[lane] = last_row;
    }

    void drop_unselected() {
        size_t kept_count = 0;
        for (size_t c = 0; c < count_; ++c) {
            const bool keep = bits(is_selected(c)) != 0;
            store(squared_ + kept_count * kLanes, squared(c));
            slots_[kept_count] = slots_[c];
            kept_count += keep;
        }
        count_ = kept_count;
    }

    // A tree has less than 2^48 rows, and a group far less than 2^16 candidates.
    static constexpr uint64_t kMaxCandidate = 0xFFFF;

    void sort_by_row() {
        for (size_t c = 0; c < count_; ++c) order_[c] = static_cast<uint64_t>(row(c)) << 16 | c;
        sort_ascending(order_, count_);
    }

    const Tree& tree_;
    const QueryGroup& group_;
    const size_t k_, capacity_, first_tightening_;
    double* squared_;  // [candidate][query]
    uint64_t* slots_;  // of the candidates: kFanout * leaf + position in the leaf
    uint64_t* order_;  // row << 16 | candidate
    size_t count_ = 0;
    alignas(64) double limit_[kLanes];     // squared distance that contains the k nearest points
    alignas(64) double last_row_[kLanes];  // highest row that is selected among the points at exactly that distance
    double bound_ = kUnbounded;
};

// Queries are points of the tree, sorted into leaves. `rows` maps them to points; null means that rows are points.
inline void planes(const Tree& tree, const Leaf* queries, size_t leaf_count, const int64_t* rows, size_t k,
                   double* normals, double* variation, double* distances, int64_t* indices, double* reach,
                   double* const* scratch, Interrupt& interrupt) {
    // Queries that are far apart share no candidates. Measured on cities of 250,000 and 5,000,000 points: below a
    // twentieth of the points, one query at a time is faster.
    const size_t group_size = 20 * leaf_count < tree.leaf_count ? 1 : kFanout;
#pragma omp parallel for schedule(dynamic, 64)
    for (size_t q = 0; q < leaf_count; ++q) {
        if (q % 16 == 0 && interrupt.requested()) continue;
        for (size_t first = 0; first < kFanout && queries[q].row[first] != kNoRow; first += group_size) {
            QueryGroup group(queries[q], first, group_size);
            if (rows)
                for (size_t& point : group.point) point = static_cast<size_t>(rows[point]);
            GroupPlanes planes_of_group(tree, group, k, scratch[omp_get_thread_num()]);
            traverse(tree, planes_of_group);
            planes_of_group.fit(normals, variation, distances, indices, reach);
        }
    }
}

}  // namespace pcbench::PCB_ISA
