// Layout of the search tree: leaves of eight points, and levels of nodes with the boxes of eight children each.
//
// All leaves and all nodes of a level are full, except for the last. Child c of node j is therefore node (or leaf)
// 8 j + c of the level below. Boxes are tight and in float64, without origin, scale or margin. Bounds are
// computed from them in the same order of operations as distances. They never exceed the distance of a point inside,
// because rounding is monotone. The tree takes about 40 bytes per point.
#pragma once
#include <cstddef>
#include <cstdint>

namespace pcbench {

constexpr size_t kFanout = 8;
constexpr size_t kMaxLevels = 11;  // 8^11 leaves hold more points than a uint32 can index
constexpr double kNoRow = UINT32_MAX;

// A point during construction.
struct alignas(32) Item {
    double p[4];  // x, y, z and the row of the input
};

// Eight points. Input rows are stored as doubles, so that they share the SIMD registers of distances.
struct alignas(32) Leaf {
    double x[kFanout], y[kFanout], z[kFanout];  // slots beyond the last point hold +inf
    double row[kFanout];                        // kNoRow beyond the last point
};

// Construction sorts the items and converts each eight of them into a leaf in place.
static_assert(sizeof(Leaf) == kFanout * sizeof(Item), "a leaf must occupy the memory of its items");

struct alignas(32) Node {
    double low[3][kFanout], high[3][kFanout];  // +inf and -inf for a missing child
    uint32_t first[kFanout];                   // lowest input row in the child, which resolves ties between boxes
};

// A view of memory owned by Index (index.h).
struct Tree {
    const double* points = nullptr;  // (count, 3), owned by the caller
    size_t count = 0;
    Leaf* leaves = nullptr;
    size_t leaf_count = 0;
    Node* levels[kMaxLevels] = {};  // levels[0]: boxes of leaves; the last level: the root
    size_t level_size[kMaxLevels] = {};
    size_t level_count = 0;
};

}  // namespace pcbench
