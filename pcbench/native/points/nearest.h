// The nearest point of each query, eight queries at a time.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include "common/interrupt.h"
#include "points/group.h"
#include "points/neighbor_lists.h"

namespace pcbench::PCB_ISA {

// With kTies, also the squared distance to the nearest point other than the match, if it is less than the match's plus
// `slack`.
template <bool kTies>
class GroupNearest {
public:
    GroupNearest(const Tree& tree, const QueryGroup& group, double slack) : tree_(tree), group_(group), slack_(slack) {
        store(best_, splat(kUnbounded));
        store(row_, splat(kNoRow));
        if (kTies) store(second_, splat(kUnbounded));
    }

    // Any leaf is valid. The leaf of the previous group's match usually gives a low first bound, which prunes more.
    void start(uint32_t leaf) {
        start_leaf_ = best_leaf_ = leaf;
        visit_all(leaf);
        bound_ = max_lane(limits());
    }

    // Starts in the queries' own leaf and excludes each query from its own candidates.
    void start_in_own_leaf(uint32_t leaf) {
        start_leaf_ = best_leaf_ = leaf;
        visit_all<true>(leaf);
        bound_ = max_lane(limits());
    }

    void apply_hints(const int64_t* hints) {
        for (int l = 0; l < kLanes; ++l) {
            const int64_t hint = hints[group_.row[l]];
            const double* p = tree_.points + 3 * hint;
            const double dx = group_.x[l] - p[0], dy = group_.y[l] - p[1], dz = group_.z[l] - p[2];
            update_best(l, (dx * dx + dy * dy) + dz * dz, static_cast<double>(hint));
        }
        bound_ = max_lane(load(best_));
    }

    Vector squared_gaps(const Node& node) const { return pcbench::PCB_ISA::squared_gaps(node, group_.box); }
    double bound() const { return bound_; }

    uint32_t last_tie() const {
        if (kTies && bits(untied())) return UINT32_MAX;
        double last = 0;
        for (int l = 0; l < kLanes; ++l)
            if (best_[l] == bound_ && row_[l] > last) last = row_[l];
        return static_cast<uint32_t>(last);
    }

    void leaf(uint32_t leaf, const Node& parent, int child) {
        if (leaf == start_leaf_) return;
        unsigned lanes = bits(group_.squared_gaps_to(parent, child) <= limits());
        if (!lanes) return;
        bool improved = false;
        if (__builtin_popcount(lanes) > 2)
            improved = visit_all(leaf);
        else
            for (; lanes; lanes &= lanes - 1) improved |= visit_one(leaf, __builtin_ctz(lanes));
        if (!improved) return;
        best_leaf_ = leaf;
        bound_ = max_lane(limits());
    }

    uint32_t best_leaf() const { return best_leaf_; }
    double squared(int lane) const { return best_[lane]; }
    int64_t row(int lane) const { return static_cast<int64_t>(row_[lane]); }
    bool tied(int lane) const { return second_[lane] - best_[lane] < slack_; }

private:
    // Squared distances up to which points matter. Rounding is monotone: d - best < slack implies d <= best + slack,
    // each rounded once. A query with a tie needs only its match: points skipped from then on are no nearer than that
    // tie.
    Vector limits() const { return kTies ? select(untied(), load(best_) + splat(slack_), load(best_)) : load(best_); }
    Mask untied() const { return splat(slack_) <= load(second_) - load(best_); }

    // One point at a time, against eight queries.
    template <bool kIsOwnLeaf = false>
    bool visit_all(uint32_t id) {
        const Leaf& leaf = tree_.leaves[id];
        const Vector x = load(group_.x), y = load(group_.y), z = load(group_.z), before = load(best_);
        Vector best = before, row = load(row_), second = kTies ? load(second_) : before;
        for (size_t i = 0; i < kFanout; ++i) {
            Vector squared = squared_length(x - splat(leaf.x[i]), y - splat(leaf.y[i]), z - splat(leaf.z[i]));
            if (kIsOwnLeaf) squared = select(mask_from_bits(1u << i), splat(HUGE_VAL), squared);
            const Vector index = splat(leaf.row[i]);
            const Mask better = (squared < best) | ((squared == best) & (index < row));
            if (kTies) second = min(second, max(best, squared));
            best = min(best, squared);
            row = select(better, index, row);
        }
        store(best_, best);
        store(row_, row);
        if (kTies) store(second_, second);
        return bits(best < before);
    }

    // One query, against eight points.
    bool visit_one(uint32_t id, int lane) {
        const Leaf& leaf = tree_.leaves[id];
        alignas(64) double squared[kLanes];
        const Vector d = squared_length(splat(group_.x[lane]) - load(leaf.x), splat(group_.y[lane]) - load(leaf.y),
                                        splat(group_.z[lane]) - load(leaf.z));
        unsigned near = bits(d <= splat(kTies && !tied(lane) ? best_[lane] + slack_ : best_[lane]));
        if (!near) return false;
        store(squared, d);
        bool improved = false;
        for (; near; near &= near - 1) {
            const int i = __builtin_ctz(near);
            improved |= update_best(lane, squared[i], leaf.row[i]);
        }
        return improved;
    }

    bool update_best(int lane, double squared, double row) {
        if (kTies) {
            const double loser = squared > best_[lane] ? squared : best_[lane];
            second_[lane] = loser < second_[lane] ? loser : second_[lane];
        }
        if (!is_before(squared, row, best_[lane], row_[lane])) return false;
        best_[lane] = squared, row_[lane] = row;
        return true;
    }

    const Tree& tree_;
    const QueryGroup& group_;
    const double slack_;
    alignas(64) double best_[kLanes];
    alignas(64) double row_[kLanes];
    alignas(64) double second_[kLanes];
    double bound_ = kUnbounded;
    uint32_t start_leaf_ = 0, best_leaf_ = 0;
};

template <bool kTies>
inline void nearest_in_chunk(const Tree& tree, const Leaf* queries, size_t begin, size_t end, const int64_t* hints,
                             bool own_leaves, double* distances, int64_t* indices, Ties ties, Interrupt& interrupt) {
    uint32_t start_leaf = 0;
    for (size_t q = begin; q < end; ++q) {
        if (q % 16 == 0 && interrupt.requested()) return;
        const QueryGroup group(queries[q]);
        // The rows are scattered over the result: prefetch them during the traversal.
        for (size_t row : group.row) __builtin_prefetch(distances + row, 1), __builtin_prefetch(indices + row, 1);
        GroupNearest<kTies> search(tree, group, ties.slack);
        if (own_leaves)
            search.start_in_own_leaf(static_cast<uint32_t>(q));
        else
            search.start(start_leaf);
        if (hints) search.apply_hints(hints);
        traverse(tree, search);
        start_leaf = search.best_leaf();
        for (int l = 0; l < group.count; ++l) {
            distances[group.row[l]] = std::sqrt(search.squared(l));
            indices[group.row[l]] = search.row(l);
            if (kTies) ties.flags[group.row[l]] = search.tied(l);
        }
    }
}

// The box of eight queries that are far apart contains many points that are near none of them. Measured on cities of
// 250,000 and 5,000,000 points: below a fiftieth of the points, one query at a time is faster.
inline bool is_sparse(size_t leaf_count, const Tree& tree) { return 50 * leaf_count < tree.leaf_count; }

inline void nearest_one_by_one(const Tree& tree, const Leaf* queries, size_t leaf_count, const int64_t* hints,
                               double* distances, int64_t* indices, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 16) if (leaf_count > 64)
    for (size_t q = 0; q < leaf_count; ++q) {
        if (interrupt.requested()) continue;
        for (size_t l = 0; l < kFanout && queries[q].row[l] != kNoRow; ++l) {
            const double query[3] = {queries[q].x[l], queries[q].y[l], queries[q].z[l]};
            const size_t row = static_cast<size_t>(queries[q].row[l]);
            NearestK search(tree, query, 1, distances + row, indices + row);
            if (hints) search.start(hints[row]);
            traverse(tree, search);
            distances[row] = std::sqrt(distances[row]);
        }
    }
}

// `queries` are leaves, sorted in space, with the row of each query. `own_leaves` means that they are the tree's
// leaves. Ties are not supported together with hints.
inline void nearest(const Tree& tree, const Leaf* queries, size_t leaf_count, const int64_t* hints, bool own_leaves,
                    double* distances, int64_t* indices, Ties ties, Interrupt& interrupt) {
    if (is_sparse(leaf_count, tree) && !ties.flags)
        return nearest_one_by_one(tree, queries, leaf_count, hints, distances, indices, interrupt);
    constexpr size_t kChunk = 256;
    const auto search_chunk = ties.flags ? nearest_in_chunk<true> : nearest_in_chunk<false>;
#pragma omp parallel for schedule(dynamic) if (leaf_count > 4 * kChunk)
    for (size_t begin = 0; begin < leaf_count; begin += kChunk) {
        const size_t end = begin + kChunk < leaf_count ? begin + kChunk : leaf_count;
        search_chunk(tree, queries, begin, end, hints, own_leaves, distances, indices, ties, interrupt);
    }
}

// Nearest points of queries that have moved, see Track. A query is searched again only if its match may have changed.
inline void follow(const Tree& tree, const Leaf* queries, size_t leaf_count, const Track& track, double* distances,
                   Interrupt& interrupt) {
    constexpr double kMargin = 1e-12;  // far above the relative rounding errors of distances
#pragma omp parallel for schedule(dynamic, 64) if (leaf_count > 1024)
    for (size_t q = 0; q < leaf_count; ++q) {
        if (interrupt.requested()) continue;
        for (size_t l = 0; l < kFanout && queries[q].row[l] != kNoRow; ++l) {
            const double query[3] = {queries[q].x[l], queries[q].y[l], queries[q].z[l]};
            const size_t row = static_cast<size_t>(queries[q].row[l]);
            const auto distance_to = [&](const double* p) {
                const double dx = query[0] - p[0], dy = query[1] - p[1], dz = query[2] - p[2];
                return std::sqrt((dx * dx + dy * dy) + dz * dz);
            };
            double* const place = track.places + 3 * row;
            if (track.clearances[row] > 0.0) {
                const double distance = distance_to(tree.points + 3 * track.indices[row]);
                if (distance + distance_to(place) < track.clearances[row] * (1 - kMargin)) {
                    distances[row] = distance;
                    continue;
                }
            }
            double squared[2] = {kUnbounded, kUnbounded};  // the second one stays if there is one point
            int64_t nearest_rows[2];
            NearestK search(tree, query, 2, squared, nearest_rows);
            traverse(tree, search);
            distances[row] = std::sqrt(squared[0]);
            track.indices[row] = nearest_rows[0];
            track.clearances[row] = std::sqrt(squared[1]);
            for (int a = 0; a < 3; ++a) place[a] = query[a];
        }
    }
}

}  // namespace pcbench::PCB_ISA
