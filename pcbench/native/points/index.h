// The tree with its memory, and queries sorted in space: the input of the kernels.
#pragma once
#include "common/block.h"
#include "points/kernels.h"

namespace pcbench {

// Keeps squared distances far below kUnbounded (walk.h) and overflow.
constexpr double kCoordinateLimit = 1e100;

struct SortedPoints {
    Block<Leaf> leaves;
    size_t leaf_count;
    bool valid;  // whether every coordinate is finite and within the limit

    SortedPoints(const double* points, size_t count, Interrupt& interrupt, Node* nodes = nullptr)
        : leaves(allocate<Leaf>((count + kFanout - 1) / kFanout)), leaf_count((count + kFanout - 1) / kFanout) {
        valid = kernels().sort_into_leaves(points, count, kCoordinateLimit, leaves.get(), nodes, interrupt);
    }
};

class Index {
public:
    Index(const double* points, size_t count, Interrupt& interrupt)
        : levels_{allocate<Node>((count + kFanout * kFanout - 1) / (kFanout * kFanout))},
          sorted_(points, count, interrupt, levels_[0].get()) {
        tree_.points = points;
        tree_.count = count;
        tree_.leaves = sorted_.leaves.get();
        tree_.leaf_count = sorted_.leaf_count;
        size_t nodes = 0;
        for (size_t below = tree_.leaf_count; below > 1 || tree_.level_count == 0;) {
            below = (below + kFanout - 1) / kFanout;
            Block<Node>& level = levels_[tree_.level_count];
            if (!level) level = allocate<Node>(below);
            tree_.levels[tree_.level_count] = level.get();
            tree_.level_size[tree_.level_count++] = below;
            nodes += below;
        }
        bytes_ = tree_.leaf_count * sizeof(Leaf) + nodes * sizeof(Node);
        if (sorted_.valid && !interrupt.requested()) kernels().build_upper_levels(tree_);
    }

    const Tree& tree() const { return tree_; }
    bool valid() const { return sorted_.valid; }
    size_t bytes() const { return bytes_; }

private:
    Block<Node> levels_[kMaxLevels];
    SortedPoints sorted_;
    Tree tree_;
    size_t bytes_;
};

}  // namespace pcbench
