// Grouping of points by cubic cell, with a hash table that is filled in the order of the points.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace pcbench {

// Integer coordinates of a cell.
struct Cell {
    int32_t x, y, z;
    bool operator==(const Cell& other) const { return x == other.x && y == other.y && z == other.z; }
    uint64_t hash() const {
        const uint64_t xy = static_cast<uint64_t>(static_cast<uint32_t>(x)) << 32 | static_cast<uint32_t>(y);
        return ((xy * 0x9E3779B97F4A7C15u) ^ (static_cast<uint32_t>(z) * 0xC2B2AE3D27D4EB4Fu)) * 0x165667B19E3779F9u;
    }
};

// Maps points to cells; points more than 2^31 cells from the corner share the outermost cells.
class Grid {
public:
    Grid(double side, const double* lower) : side_(side), lower_{lower[0], lower[1], lower[2]} {}

    Cell cell(const double* p) const { return {coordinate(p, 0), coordinate(p, 1), coordinate(p, 2)}; }

private:
    int32_t coordinate(const double* p, int axis) const {
        const double cell = std::clamp((p[axis] - lower_[axis]) / side_, -2147483648.0, 2147483647.0);
        const auto truncated = static_cast<int32_t>(cell);
        return truncated - (cell < truncated);  // std::floor is a function call on older processors
    }

    double side_, lower_[3];
};

struct OccupiedCells {
    std::vector<int64_t> first, counts;  // first point and number of points of each cell
};

// Groups points, or those at `count` rows unless `rows` is null, and writes the cell of each unless `labels` is null.
// Cells are numbered in the order of their first points.
inline OccupiedCells group_by_cell(const double* points, size_t count, const Grid& grid, const int64_t* rows,
                                   int64_t* labels) {
    constexpr uint32_t kNone = UINT32_MAX;
    constexpr size_t kBatch = 64;  // slots are prefetched together: a single access would wait for memory
    unsigned bits = 10;
    std::vector<uint32_t> table(size_t{1} << bits, kNone);  // labels
    std::vector<Cell> labelled;                             // the cell of each label
    OccupiedCells cells;
    const auto row = [&](size_t i) { return rows ? rows[i] : static_cast<int64_t>(i); };
    const auto slot_of = [&](const Cell& cell) { return cell.hash() >> (64 - bits); };
    const auto find = [&](const Cell& cell) -> uint32_t& {
        size_t at = slot_of(cell);
        while (table[at] != kNone && !(labelled[table[at]] == cell)) at = (at + 1) & (table.size() - 1);
        return table[at];
    };
    const auto grow = [&] {
        bits += 2;
        table.assign(size_t{1} << bits, kNone);
        for (uint32_t label = 0; label < labelled.size(); ++label) {
            size_t at = slot_of(labelled[label]);
            while (table[at] != kNone) at = (at + 1) & (table.size() - 1);
            table[at] = label;
        }
    };
    for (size_t start = 0; start < count; start += kBatch) {
        const size_t size = std::min(kBatch, count - start);
        while (2 * (labelled.size() + size) > table.size()) grow();
        Cell batch_cells[kBatch];
        for (size_t i = 0; i < size; ++i) {
            batch_cells[i] = grid.cell(points + 3 * row(start + i));
            __builtin_prefetch(&table[slot_of(batch_cells[i])], 1);
        }
        for (size_t i = 0; i < size; ++i) {
            uint32_t& label = find(batch_cells[i]);
            if (label == kNone) {
                label = static_cast<uint32_t>(labelled.size());
                labelled.push_back(batch_cells[i]);
                cells.first.push_back(row(start + i));
                cells.counts.push_back(0);
            }
            if (labels) labels[start + i] = label;
            ++cells.counts[label];
        }
    }
    return cells;
}

}  // namespace pcbench
