// Planes through the k nearest points of points of the tree, eight neighbouring queries at a time. The neighbours are
// not listed: each query only determines the distance that separates its k nearest points from the rest.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include <omp.h>

#include "common/eigen.h"
#include "common/interrupt.h"
#include "points/group.h"
#include "points/ranks.h"

namespace pcbench::PCB_ISA {

// Memory for the candidates of one group, one per thread and reused.
struct PlaneScratch {
    // After tightening, at most k points remain for each query.
    static size_t points(size_t k) { return kLanes * k + 8 * kFanout * kFanout; }
    static size_t bytes(size_t k) {
        return points(k) * (sizeof(double[kLanes]) + sizeof(uint32_t[4])) + sizeof(int32_t[kRanksPerPass]);
    }
};

class GroupPlanes {
public:
    // Only points within the squared distance `limit` of a query are candidates.
    GroupPlanes(const Tree& tree, const QueryGroup& group, size_t k, double limit, double* scratch)
        : tree_(tree),
          group_(group),
          k_(k),
          capacity_(PlaneScratch::points(k)),
          tightening_(limit == kUnbounded ? 2 * k + 4 * kFanout : 8 * k),
          squared_(scratch),
          slots_(reinterpret_cast<uint32_t*>(scratch + capacity_ * kLanes)),
          listed_(slots_ + capacity_),
          order_(listed_ + capacity_),
          keys_(reinterpret_cast<int32_t*>(order_ + capacity_)),
          bound_(limit) {
        store(limit_, splat(limit));
        store(last_row_, splat(kNoRow));
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, group_.box); }
    double bound() const { return bound_; }
    uint32_t last_tie() const { return bound_ == 0.0 ? static_cast<uint32_t>(max_lane(load(last_row_))) : UINT32_MAX; }

    void leaf(uint32_t id, const Node& parent, int child) {
        if (!bits(group_.squared_gaps_to(parent, child) <= load(limit_))) return;
        if (count_ + kFanout > capacity_) {
            select_neighbors();
            drop_unselected();
        }
        const Leaf& leaf = tree_.leaves[id];
        const Vector x = load(group_.x), y = load(group_.y), z = load(group_.z), limit = load(limit_);
        size_t count = count_;
        for (size_t i = 0; i < kFanout; ++i) {
            const Vector squared = squared_length(x - splat(leaf.x[i]), y - splat(leaf.y[i]), z - splat(leaf.z[i]));
            store(squared_ + count * kLanes, squared);
            slots_[count] = static_cast<uint32_t>(kFanout * id + i);
            count += bits(squared <= limit) != 0;
        }
        count_ = count;
        if (tightening_ <= count_) {
            tighten();
            drop_unselected();
            tightening_ = capacity_ + 1;
        }
    }

    // Selects the k nearest points of each query. Returns false if one has fewer candidates.
    bool select_neighbors() {
        Bracket bracket = whole_bracket();
        const unsigned complete = bits(splat(static_cast<double>(k_)) <= bracket.within);
        narrow(bracket, 7, 0, 2);
        limit_to(bracket);
        // Points at equal distances, and a few at the end of the search, are compared one by one.
        const unsigned undecided = bits(splat(static_cast<double>(k_)) < bracket.within);
        for (unsigned lanes = undecided; lanes; lanes &= lanes - 1) select_from(bracket, __builtin_ctz(lanes));
        bound_ = max_lane(load(limit_));
        return complete == 0xff;
    }

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
    // For each query, two squared distances and the numbers of candidates up to them: fewer than k up to `low`, and at
    // least k up to `high`, except for queries with fewer candidates.
    struct Bracket {
        Vector low, below, high, within;
    };

    Vector squared(size_t c) const { return load(squared_ + c * kLanes); }
    double row(size_t c) const { return tree_.leaves[slots_[c] / kFanout].row[slots_[c] % kFanout]; }

    Mask is_selected(size_t c) const {
        const Vector limit = load(limit_);
        if (!has_ties_) return squared(c) <= limit;
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

    Bracket whole_bracket() const {
        const Vector zero = splat(0.0), one = splat(1.0), limit = load(limit_);
        Vector high = zero, within = zero;
        for (size_t c = 0; c < count_; ++c) {
            const Mask inside = squared(c) <= limit;
            within = within + select(inside, one, zero);
            high = max(high, select(inside, squared(c), zero));
        }
        return {splat(-1.0), zero, high, within};
    }

    // Narrows the brackets until they contain k to k + surplus candidates or are no wider than `width` candidates. On a
    // surface the number of points is about linear in the squared distance, so interpolation takes few rounds.
    void narrow(Bracket& b, int max_rounds, size_t surplus, double width) const {
        const Vector k = splat(static_cast<double>(k_)), zero = splat(0.0);
        const Vector target = splat(static_cast<double>(k_) + 0.5 * static_cast<double>(surplus + 1));
        for (int round = 0; round < max_rounds; ++round) {
            const Mask done =
                (b.within <= splat(static_cast<double>(k_ + surplus))) | (b.within - b.below <= splat(width));
            if (bits(done) == 0xff) break;
            const Vector low = max(b.low, zero);
            const Vector share = round % 3 == 2 ? splat(0.5) : (target - b.below) / (b.within - b.below + splat(1.0));
            const Vector middle = select(done, b.high, low + (b.high - low) * share);
            const Vector count = count_up_to(middle);
            const Mask over = done | (k <= count);
            b.high = select(over, middle, b.high), b.within = select(over, count, b.within);
            b.low = select(over, b.low, middle), b.below = select(over, b.below, count);
        }
    }

    // Queries with fewer than k candidates keep their limits.
    void limit_to(const Bracket& b) {
        store(limit_, select(splat(static_cast<double>(k_)) <= b.within, b.high, load(limit_)));
        store(last_row_, splat(kNoRow));
        has_ties_ = false;
        bound_ = max_lane(load(limit_));
    }

    // Lowers the limits roughly: about k candidates remain for each query, never fewer.
    void tighten() {
        Bracket bracket = whole_bracket();
        narrow(bracket, 2, k_ / 4, 0);
        limit_to(bracket);
    }

    // Sets the limit of one query to its k-th candidate by (distance, row), which its bracket contains.
    void select_from(const Bracket& bracket, int lane) {
        alignas(64) double low[kLanes], below[kLanes], high[kLanes];
        store(low, bracket.low), store(below, bracket.below), store(high, bracket.high);
        const double lowest = low[lane], highest = high[lane];
        size_t count = 0;
        for (size_t c = 0; c < count_; ++c) {
            const double s = squared_[c * kLanes + lane];
            listed_[count] = static_cast<uint32_t>(c);
            count += static_cast<size_t>(lowest < s) & static_cast<size_t>(s <= highest);
        }
        const auto squared = [&](size_t i) { return squared_[listed_[i] * kLanes + lane]; };
        // Quickselect (Hoare 1961).
        const size_t rank = k_ - static_cast<size_t>(below[lane]) - 1;
        for (size_t first = 0, last = count - 1; first < last;) {
            const double s = squared((first + last) / 2), r = row(listed_[(first + last) / 2]);
            size_t i = first, j = last;
            for (;; ++i, --j) {
                while (is_before(squared(i), row(listed_[i]), s, r)) ++i;
                while (is_before(s, r, squared(j), row(listed_[j]))) --j;
                if (i >= j) break;
                const uint32_t swapped = listed_[i];
                listed_[i] = listed_[j], listed_[j] = swapped;
            }
            if (rank <= j)
                last = j;
            else
                first = j + 1;
        }
        limit_[lane] = squared(rank), last_row_[lane] = row(listed_[rank]);
        for (size_t i = rank + 1; i < count; ++i) has_ties_ |= squared(i) == limit_[lane];
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

    const Tree& tree_;
    const QueryGroup& group_;
    const size_t k_, capacity_;
    size_t tightening_;  // number of candidates at which the limits are lowered for the first time
    double* squared_;    // [candidate][query]
    uint32_t* slots_;    // of the candidates: kFanout * leaf + position in the leaf
    uint32_t* listed_;   // candidates in no particular order
    uint32_t* order_;    // candidates by row
    int32_t* keys_;      // rows of the listed candidates, shifted into the range of the type
    size_t count_ = 0;
    bool has_ties_ = false;                // whether a point at a query's limit is not selected
    alignas(64) double limit_[kLanes];     // squared distance that contains the k nearest points
    alignas(64) double last_row_[kLanes];  // highest row that is selected among the points at exactly that distance
    double bound_;
};

// Queries are points of the tree, sorted into leaves. `rows` maps them to points; null means that rows are points.
inline void planes(const Tree& tree, const Leaf* queries, size_t leaf_count, const int64_t* rows, size_t k,
                   double* normals, double* variation, double* distances, int64_t* indices, double* reach,
                   double* const* scratch, Interrupt& interrupt) {
    // Queries that are far apart share no candidates. Measured on cities of 250,000 and 5,000,000 points: below a
    // twentieth of the points, one query at a time is faster.
    const size_t group_size = 20 * leaf_count < tree.leaf_count ? 1 : kFanout;
    // The neighbours of a group are usually about as far away as those of the previous group. On cities and scan lines,
    // 5 to 10 % of the groups have neighbours beyond this multiple, in squared units, and are searched again.
    constexpr double kGrowth = 1.6;
#pragma omp parallel
    {
        double limit = kUnbounded;
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
                    GroupPlanes planes_of_group(tree, group, k, limit, scratch[omp_get_thread_num()]);
                    traverse(tree, planes_of_group);
                    complete = planes_of_group.select_neighbors();
                    const double farthest =
                        complete ? planes_of_group.fit(normals, variation, distances, indices, reach) : 0.0;
                    limit = farthest > 0.0 ? kGrowth * farthest : kUnbounded;
                }
            }
        }
    }
}

}  // namespace pcbench::PCB_ISA
