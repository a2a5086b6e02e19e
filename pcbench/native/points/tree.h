// What an index holds: points in leaves of eight, and levels of nodes with the boxes of eight children each.
//
// Every leaf and node but the last of its level is full, so a child is found by arithmetic: child c of node j is
// node (or leaf) 8 j + c of the level below. Boxes are float64 and tight: no origin, no scale, no margin. A bound
// computed from them in the order of the distance itself never exceeds the distance of a point inside, because
// rounding is monotone. 40 bytes a point.
#pragma once
#include <cstddef>
#include <cstdint>

namespace pcbench {

constexpr size_t kFan = 8;
constexpr size_t kMaxLevels = 11;  // 8^11 leaves hold more points than a uint32 can number
constexpr double kNoRow = UINT32_MAX;

// A point on its way into a leaf.
struct alignas(32) Item {
    double p[4];  // x, y, z and the row of the input
};

// Eight points. Rows of the input are kept as doubles: they travel in the same registers as the distances.
struct alignas(32) Leaf {
    double x[kFan], y[kFan], z[kFan];  // slots beyond the last point hold +inf
    double row[kFan];                  // kNoRow beyond the last point
};

// The build sorts items and turns each eight of them into a leaf in place.
static_assert(sizeof(Leaf) == kFan * sizeof(Item), "a leaf takes the room of its items");

struct alignas(32) Node {
    double low[3][kFan], high[3][kFan];  // +inf, -inf where there is no child
    uint32_t first[kFan];                // lowest row of the input in the child: decides ties between boxes
};

// A view: the memory belongs to Index (index.h).
struct Tree {
    const double* points = nullptr;  // (count, 3), the caller's
    size_t count = 0;
    Leaf* leaves = nullptr;
    size_t leaf_count = 0;
    Node* levels[kMaxLevels] = {};  // levels[0]: boxes of leaves; the last one: the root alone
    size_t level_size[kMaxLevels] = {};
    size_t level_count = 0;
};

}  // namespace pcbench
