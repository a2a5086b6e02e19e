// The tree with its memory, and queries sorted in space: the input of the kernels.
#pragma once
#include <cstring>
#include <optional>
#include <utility>

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
        : Index(points, count, allocate<Node>(node_count(count)), nullptr) {
        sorted_.emplace(points, count, interrupt, tree_.levels[0]);
        tree_.leaves = sorted_->leaves.get();
        if (sorted_->valid && !interrupt.requested()) kernels().build_upper_levels(tree_);
    }

    // An index of the same points whose tree `copy_to` wrote to memory, which must outlive it.
    Index(const double* points, size_t count, const double* memory)
        : Index(points, count, nullptr, reinterpret_cast<Node*>(const_cast<double*>(memory) + leaf_doubles(count))) {
        tree_.leaves = reinterpret_cast<Leaf*>(const_cast<double*>(memory));  // searches do not change it
    }

    static size_t doubles(size_t count) {
        return leaf_doubles(count) + node_count(count) * sizeof(Node) / sizeof(double);
    }

    void copy_to(double* memory) const {
        std::memcpy(memory, tree_.leaves, tree_.leaf_count * sizeof(Leaf));
        std::memcpy(memory + leaf_doubles(tree_.count), tree_.levels[0], node_count(tree_.count) * sizeof(Node));
    }

    const Tree& tree() const { return tree_; }
    bool valid() const { return !sorted_ || sorted_->valid; }
    size_t bytes() const { return doubles(tree_.count) * sizeof(double); }

private:
    // The levels lie one after the other, from the boxes of leaves to the root.
    Index(const double* points, size_t count, Block<Node> nodes, Node* stored) : nodes_(std::move(nodes)) {
        tree_.points = points;
        tree_.count = count;
        tree_.leaf_count = parents(count);
        Node* next = nodes_ ? nodes_.get() : stored;
        for (size_t below = tree_.leaf_count; below > 1 || tree_.level_count == 0;) {
            below = parents(below);
            tree_.levels[tree_.level_count] = next;
            tree_.level_size[tree_.level_count++] = below;
            next += below;
        }
    }

    static size_t parents(size_t count) { return (count + kFanout - 1) / kFanout; }
    static size_t leaf_doubles(size_t count) { return parents(count) * sizeof(Leaf) / sizeof(double); }
    static size_t node_count(size_t count) {
        size_t below = parents(count), nodes = 0;
        do nodes += below = parents(below);
        while (below > 1);
        return nodes;
    }

    Block<Node> nodes_;
    std::optional<SortedPoints> sorted_;
    Tree tree_;
};

}  // namespace pcbench
