// A tree of boxes over triangles, and its construction. Each node has four children; their float32 boxes are stored
// side by side for SIMD.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "common/first_error.h"
#include "common/interrupt.h"

namespace pcbench::mesh {

typedef float Float4 __attribute__((vector_size(16)));

inline Float4 maximum(Float4 a, Float4 b) { return a > b ? a : b; }
inline Float4 minimum(Float4 a, Float4 b) { return a < b ? a : b; }
inline Float4 broadcast(float value) { return Float4{value, value, value, value}; }

// Child k is a node if count[k] is 0, else the triangles first[k], first[k] + 1, ... A node takes two cache lines.
struct alignas(64) Node {
    Float4 low[3], high[3];
    uint32_t first[4], count[4];
};

struct Box {
    float low[3] = {HUGE_VALF, HUGE_VALF, HUGE_VALF}, high[3] = {-HUGE_VALF, -HUGE_VALF, -HUGE_VALF};

    void include(const float* l, const float* h) {
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = std::min(low[axis], l[axis]);
            high[axis] = std::max(high[axis], h[axis]);
        }
    }
    float half_area() const {
        const float x = high[0] - low[0], y = high[1] - low[1], z = high[2] - low[2];
        return x * y + y * z + z * x;
    }
};

struct Item {  // a triangle during construction
    Box box;
    uint32_t face;
    float twice_centre(int axis) const { return box.low[axis] + box.high[axis]; }
};

class Builder {
public:
    static constexpr uint32_t kMaxLeafTriangles = 2;
    static constexpr uint32_t kMinInterruptibleTriangles = 256;  // smaller ranges are not worth a check for interrupts
    static constexpr int kBins = 12;                             // candidate splits of the surface area heuristic
    static constexpr int kMaxSahDepth = 40;  // deeper ranges are split in half, which bounds the depth of the tree
    static constexpr int kMaxDepth = kMaxSahDepth + 32;

    Builder(std::vector<Item>& items, Interrupt& interrupt) : items_(items), interrupt_(interrupt) {}

    // Returns the nodes, root first, in an order that depends only on the triangles. Some are missing if interrupted.
    std::vector<Node> build() {
        const uint32_t size = static_cast<uint32_t>(items_.size());
        std::vector<Node> nodes;
        std::vector<PendingSubtree> jobs;
        build_subtree(nodes, Range(items_, 0, size), 0, std::max(1u << 14, size / 64), &jobs);
        std::vector<std::vector<Node>> parts(jobs.size());
        FirstError error;
#pragma omp parallel for schedule(dynamic, 1)
        for (size_t j = 0; j < jobs.size(); ++j)
            error.guard([&] { build_subtree(parts[j], jobs[j].range, jobs[j].depth, 0, nullptr); });
        error.rethrow();
        for (size_t j = 0; j < jobs.size(); ++j) {
            const uint32_t offset = static_cast<uint32_t>(nodes.size());
            nodes[jobs[j].node].first[jobs[j].slot] = offset;
            for (Node& node : parts[j]) {
                for (int k = 0; k < 4; ++k)
                    if (node.count[k] == 0) node.first[k] += offset;
                nodes.push_back(node);
            }
        }
        return nodes;
    }

private:
    struct Range {
        uint32_t begin = 0, end = 0;
        Box box;
        Range() = default;
        Range(const std::vector<Item>& items, uint32_t b, uint32_t e) : begin(b), end(e) {
            for (uint32_t i = b; i < e; ++i) box.include(items[i].box.low, items[i].box.high);
        }
        uint32_t size() const { return end - begin; }
    };
    struct PendingSubtree {  // built later by one thread
        Range range;
        int depth;
        uint32_t node;
        int slot;
    };

    // Builds a subtree. Ranges of at most `max_pending_size` triangles are queued in `jobs`, if given, instead of
    // built.
    uint32_t build_subtree(std::vector<Node>& nodes, const Range& range, int depth, uint32_t max_pending_size,
                           std::vector<PendingSubtree>* jobs) {
        if (range.size() > kMinInterruptibleTriangles && interrupt_.requested()) return 0;
        Range children[4];
        children[0] = range;
        int count = 1;
        while (count < 4) {  // split the child with the largest surface, which most queries would enter
            int widest = -1;
            for (int k = 0; k < count; ++k)
                if (children[k].size() > kMaxLeafTriangles &&
                    (widest < 0 || children[k].box.half_area() > children[widest].box.half_area()))
                    widest = k;
            if (widest < 0) break;
            const Range parent = children[widest];
            const uint32_t middle = depth < kMaxSahDepth ? split_by_sah(parent) : split_in_half(parent);
            children[widest] = Range(items_, parent.begin, middle);
            children[count++] = Range(items_, middle, parent.end);
        }
        const uint32_t index = static_cast<uint32_t>(nodes.size());
        nodes.emplace_back();
        for (int k = 0; k < 4; ++k) {
            const Range& child = children[k];
            const bool leaf = child.size() <= kMaxLeafTriangles;  // also for an empty child, whose box is empty
            for (int axis = 0; axis < 3; ++axis) {
                nodes[index].low[axis][k] = child.box.low[axis];
                nodes[index].high[axis][k] = child.box.high[axis];
            }
            nodes[index].first[k] = child.begin;
            nodes[index].count[k] = child.size() ? child.size() : 1;
            if (leaf) continue;
            nodes[index].count[k] = 0;
            if (jobs && child.size() <= max_pending_size)
                jobs->push_back({child, depth + 1, index, k});
            else {
                const uint32_t at = build_subtree(nodes, child, depth + 1, max_pending_size, jobs);
                nodes[index].first[k] = at;
            }
        }
        return index;
    }

    // Binned surface area heuristic: Wald, "On fast construction of SAH-based bounding volume hierarchies", 2007.
    uint32_t split_by_sah(const Range& range) {
        float low[3], high[3];
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = HUGE_VALF, high[axis] = -HUGE_VALF;
            for (uint32_t i = range.begin; i < range.end; ++i) {
                const float centre = items_[i].twice_centre(axis);
                low[axis] = std::min(low[axis], centre), high[axis] = std::max(high[axis], centre);
            }
        }
        int axis = 0;
        for (int other = 1; other < 3; ++other)
            if (high[other] - low[other] > high[axis] - low[axis]) axis = other;
        const float scale = kBins / (high[axis] - low[axis]);
        if (!(scale < std::numeric_limits<float>::max())) return split_in_half(range);
        const auto bin = [&](const Item& item) {
            return std::min(kBins - 1, static_cast<int>((item.twice_centre(axis) - low[axis]) * scale));
        };
        Box boxes[kBins];
        uint32_t counts[kBins] = {};
        for (uint32_t i = range.begin; i < range.end; ++i) {
            const int b = bin(items_[i]);
            boxes[b].include(items_[i].box.low, items_[i].box.high);
            ++counts[b];
        }
        float below[kBins];  // cost of all bins up to and including this one
        Box box;
        uint32_t count = 0;
        for (int b = 0; b < kBins; ++b) {
            box.include(boxes[b].low, boxes[b].high);
            count += counts[b];
            below[b] = count ? count * box.half_area() : 0;
        }
        box = Box(), count = 0;
        float best = HUGE_VALF;
        int last = -1;  // last bin of the left side
        for (int b = kBins - 1; b > 0; --b) {
            box.include(boxes[b].low, boxes[b].high);
            count += counts[b];
            if (count == 0 || count == range.size()) continue;
            const float cost = below[b - 1] + count * box.half_area();
            if (cost < best) best = cost, last = b - 1;
        }
        if (last < 0) return split_in_half(range);
        const auto middle = std::partition(items_.begin() + range.begin, items_.begin() + range.end,
                                           [&](const Item& item) { return bin(item) <= last; });
        return static_cast<uint32_t>(middle - items_.begin());
    }

    static uint32_t split_in_half(const Range& range) { return range.begin + range.size() / 2; }

    std::vector<Item>& items_;
    Interrupt& interrupt_;
};

}  // namespace pcbench::mesh
