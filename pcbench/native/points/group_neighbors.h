// The k nearest points of eight neighbouring queries. They are not listed: each query only determines the distance that
// separates its k nearest points from the rest.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "points/group.h"

namespace pcbench::PCB_ISA {

class GroupNeighbors {
public:
    // Memory for the candidates of one group, one per thread and reused. After tightening, at most k points remain for
    // each query.
    static constexpr size_t capacity(size_t k) { return kLanes * k + 8 * kFanout * kFanout; }
    static size_t bytes(size_t k) { return capacity(k) * (sizeof(double[kLanes]) + sizeof(uint32_t[2])); }

    // Only points within the squared distance `limit` of a query are candidates.
    GroupNeighbors(const Tree& tree, const QueryGroup& group, size_t k, double limit, double* scratch)
        : tree_(tree),
          group_(group),
          k_(k),
          capacity_(capacity(k)),
          squared_(scratch),
          slots_(reinterpret_cast<uint32_t*>(scratch + capacity_ * kLanes)),
          listed_(slots_ + capacity_),
          tightening_(limit == kUnbounded ? 2 * k + 4 * kFanout : 8 * k),
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

protected:
    const Tree& tree_;
    const QueryGroup& group_;
    const size_t k_, capacity_;
    double* squared_;   // [candidate][query]
    uint32_t* slots_;   // of the candidates: kFanout * leaf + position in the leaf
    uint32_t* listed_;  // candidates in no particular order
    size_t count_ = 0;

    Vector squared(size_t c) const { return load(squared_ + c * kLanes); }
    double row(size_t c) const { return tree_.leaves[slots_[c] / kFanout].row[slots_[c] % kFanout]; }

    Mask is_selected(size_t c) const {
        const Vector limit = load(limit_);
        if (!has_ties_) return squared(c) <= limit;
        return (squared(c) < limit) | ((squared(c) == limit) & (splat(row(c)) <= load(last_row_)));
    }

private:
    // For each query, two squared distances and the numbers of candidates up to them: fewer than k up to `low`, and at
    // least k up to `high`, except for queries with fewer candidates.
    struct Bracket {
        Vector low, below, high, within;
    };

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

    size_t tightening_;                    // number of candidates at which the limits are lowered for the first time
    bool has_ties_ = false;                // whether a point at a query's limit is not selected
    alignas(64) double limit_[kLanes];     // squared distance that contains the k nearest points
    alignas(64) double last_row_[kLanes];  // highest row that is selected among the points at exactly that distance
    double bound_;
};

// Squared distance within which the neighbours of the next queries are searched. They are usually about as far away as
// those of the queries before, and farther by at most the distance between the queries.
class SearchLimit {
public:
    double of(const Box& queries) const {
        if (farthest_ == 0.0) return kUnbounded;
        double squared_gap = 0.0;
        for (int a = 0; a < 3; ++a) {
            const double low = queries.low[a] < before_.low[a] ? queries.low[a] : before_.low[a];
            const double high = queries.high[a] > before_.high[a] ? queries.high[a] : before_.high[a];
            squared_gap += (high - low) * (high - low);
        }
        const double certain = std::sqrt(farthest_) + std::sqrt(squared_gap);
        const double expected = kGrowth * farthest_, slack = 1.0 + 1e-12;
        return certain * certain * slack < expected ? certain * certain * slack : expected;
    }

    // `farthest` is the squared distance of the farthest neighbour; 0 if a query has too few within the limit.
    void update(const Box& queries, double farthest) { before_ = queries, farthest_ = farthest; }

private:
    // On cities and scan lines, 5 to 10 % of the groups have neighbours beyond this multiple and are searched again.
    static constexpr double kGrowth = 1.6;

    Box before_{};
    double farthest_ = 0.0;
};

// Queries that are far apart share no candidates. Measured on cities of 250,000 and 5,000,000 points: below a twentieth
// of the points, one query at a time is faster.
inline bool are_close(size_t query_leaves, const Tree& tree) { return 20 * query_leaves >= tree.leaf_count; }

}  // namespace pcbench::PCB_ISA
