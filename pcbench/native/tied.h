// Which queries have a second point about as near as their nearest one, eight queries at a time.
// Included once for each instruction set, see kernels_isa.h.
#pragma once
#include "group.h"
#include "interrupt.h"

namespace pcbench::PCB_ISA {

class TiesOfGroup {
public:
    // nearest: the row of each query's match in the tree.
    TiesOfGroup(const Tree& tree, const Group& group, const int64_t* nearest, double slack)
        : tree_(tree), group_(group), slack_(splat(slack)) {
        alignas(64) double x[kLanes], y[kLanes], z[kLanes];
        for (int l = 0; l < kLanes; ++l) {
            const int64_t row = nearest[group.row[l]];
            const double* p = tree.points + 3 * row;
            x[l] = p[0], y[l] = p[1], z[l] = p[2], match_[l] = static_cast<double>(row);
        }
        const Lanes squared = squared_length(load(group.x) - load(x), load(group.y) - load(y), load(group.z) - load(z));
        store(squared_, squared);
        // Rounding is monotone: d - squared < slack implies d <= squared + slack, each rounded once.
        store(limit_, squared + slack_);
        bound_ = largest(load(limit_));
    }

    Lanes gaps(const Node& node) const { return pcbench::PCB_ISA::gaps(node, group_.box); }
    double bound() const { return bound_; }
    uint32_t last_tie() const { return UINT32_MAX; }

    void leaf(uint32_t id, const Node& parent, int child) {
        unsigned lanes = bits(group_.gaps_to(parent, child) <= load(limit_));
        if (!lanes) return;
        const Leaf& leaf = tree_.leaves[id];
        const unsigned before = tied_;
        if (__builtin_popcount(lanes) > 2)
            tied_ |= lanes_with_ties(leaf);
        else
            for (; lanes; lanes &= lanes - 1)
                if (has_tie(leaf, __builtin_ctz(lanes))) tied_ |= lanes & -lanes;
        if (tied_ == before) return;
        // A lane with an answer needs nothing more: no gap is below zero.
        const Lanes limit = select(from_bits(tied_), splat(-1.0), load(limit_));
        store(limit_, limit);
        bound_ = largest(limit);
    }

    bool tied(int lane) const { return tied_ >> lane & 1; }

private:
    // One point after the other, against eight queries.
    unsigned lanes_with_ties(const Leaf& leaf) const {
        const Lanes x = load(group_.x), y = load(group_.y), z = load(group_.z), nearest = load(squared_);
        const Lanes match = load(match_);
        unsigned tied = 0;
        for (size_t i = 0; i < kFan; ++i) {
            const Lanes squared = squared_length(x - splat(leaf.x[i]), y - splat(leaf.y[i]), z - splat(leaf.z[i]));
            tied |= bits(squared - nearest < slack_) & ~bits(match == splat(leaf.row[i]));
        }
        return tied;
    }

    // One query, against eight points.
    bool has_tie(const Leaf& leaf, int lane) const {
        const Lanes squared = squared_length(splat(group_.x[lane]) - load(leaf.x), splat(group_.y[lane]) - load(leaf.y),
                                             splat(group_.z[lane]) - load(leaf.z));
        const unsigned within = bits(squared - splat(squared_[lane]) < slack_);
        return within & ~bits(load(leaf.row) == splat(match_[lane]));
    }

    const Tree& tree_;
    const Group& group_;
    const Lanes slack_;
    alignas(64) double squared_[kLanes];  // to the match
    alignas(64) double match_[kLanes];    // its row
    alignas(64) double limit_[kLanes];    // squared distance that no tie exceeds
    double bound_;
    unsigned tied_ = 0;  // one bit a lane
};

// `queries` are leaves: sorted in space, each with its row.
inline void tied(const Tree& tree, const Leaf* queries, size_t leaf_count, const int64_t* nearest, double slack,
                 bool* tied, Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic, 256) if (leaf_count > 256)
    for (size_t q = 0; q < leaf_count; ++q) {
        if (q % 16 == 0 && interrupt.requested()) continue;
        const Group group(queries[q]);
        TiesOfGroup found(tree, group, nearest, slack);
        walk(tree, found);
        for (int l = 0; l < group.count; ++l) tied[group.row[l]] = found.tied(l);
    }
}

}  // namespace pcbench::PCB_ISA
