// The tree with its memory, and queries sorted in space: what module.cpp hands to the kernels.
#pragma once
#include "block.h"
#include "kernels.h"

namespace pcbench {

// Beyond it squared distances would overflow.
constexpr double kCoordinateLimit = 1e100;

struct SortedPoints {
    Block<Leaf> leaves;
    size_t leaf_count;
    bool valid;  // every coordinate finite and within the limit

    SortedPoints(const double* points, size_t count, Interrupt& interrupt)
        : leaves(allocate<Leaf>((count + kFan - 1) / kFan)), leaf_count((count + kFan - 1) / kFan) {
        valid = kernels().arrange(points, count, kCoordinateLimit, leaves.get(), interrupt);
    }
};

class Index {
public:
    Index(const double* points, size_t count, Interrupt& interrupt) : sorted_(points, count, interrupt) {
        tree_.points = points;
        tree_.count = count;
        tree_.leaves = sorted_.leaves.get();
        tree_.leaf_count = sorted_.leaf_count;
        bytes_ = tree_.leaf_count * sizeof(Leaf);
        for (size_t below = tree_.leaf_count; below > 1 || tree_.level_count == 0;) {
            below = (below + kFan - 1) / kFan;
            Block<Node>& level = levels_[tree_.level_count];
            level = allocate<Node>(below);
            tree_.levels[tree_.level_count] = level.get();
            tree_.level_size[tree_.level_count++] = below;
            bytes_ += below * sizeof(Node);
        }
        if (sorted_.valid && !interrupt.requested()) kernels().bound(tree_);
    }

    const Tree& tree() const { return tree_; }
    bool valid() const { return sorted_.valid; }
    size_t bytes() const { return bytes_; }

private:
    SortedPoints sorted_;
    Block<Node> levels_[kMaxLevels];
    Tree tree_;
    size_t bytes_;
};

}  // namespace pcbench
