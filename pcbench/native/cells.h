// Points grouped by the cubic cell they lie in: a hash table that is filled in the order of the points.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace pcbench {

// Where a point's cell lies: 21 bits an axis; cells beyond 2^20 from the corner share the outermost one.
class Grid {
public:
    Grid(double side, const double* lower) : side_(side), lower_{lower[0], lower[1], lower[2]} {}

    uint64_t key(const double* p) const {
        constexpr double kHalf = 1 << 20;
        uint64_t key = 0;
        for (int a = 0; a < 3; ++a) {
            const double cell = std::floor((p[a] - lower_[a]) / side_);
            key = key << 21 | static_cast<uint64_t>(std::clamp(cell, -kHalf, kHalf - 1) + kHalf);
        }
        return key;
    }

private:
    double side_, lower_[3];
};

struct Occupied {
    std::vector<int64_t> first, counts;  // of each cell: its first point, and how many it has
};

// Writes each point's cell, numbered in the order in which cells first appear.
inline Occupied group_by_cell(const double* points, size_t count, const Grid& grid, int64_t* labels) {
    struct Slot {
        uint64_t key;  // keys have 63 bits
        int64_t label;
    };
    constexpr uint64_t kFree = UINT64_MAX;
    constexpr size_t kBatch = 64;  // slots are fetched together: each one alone would be a wait for memory
    unsigned bits = 10;
    std::vector<Slot> table(size_t{1} << bits, Slot{kFree, 0});
    Occupied cells;
    const auto slot_of = [&](uint64_t key) { return key * 0x9E3779B97F4A7C15u >> (64 - bits); };
    const auto find = [&](uint64_t key) -> Slot& {
        size_t at = slot_of(key);
        while (table[at].key != key && table[at].key != kFree) at = (at + 1) & (table.size() - 1);
        return table[at];
    };
    const auto grow = [&] {
        std::vector<Slot> old(size_t{4} << bits, Slot{kFree, 0});
        old.swap(table);
        bits += 2;
        for (const Slot& slot : old)
            if (slot.key != kFree) find(slot.key) = slot;
    };
    for (size_t start = 0; start < count; start += kBatch) {
        const size_t size = std::min(kBatch, count - start);
        while (2 * (cells.first.size() + size) > table.size()) grow();
        uint64_t keys[kBatch];
        for (size_t i = 0; i < size; ++i) {
            keys[i] = grid.key(points + 3 * (start + i));
            __builtin_prefetch(&table[slot_of(keys[i])], 1);
        }
        for (size_t i = 0; i < size; ++i) {
            Slot& slot = find(keys[i]);
            if (slot.key == kFree) {
                slot = {keys[i], static_cast<int64_t>(cells.first.size())};
                cells.first.push_back(static_cast<int64_t>(start + i));
                cells.counts.push_back(0);
            }
            labels[start + i] = slot.label;
            ++cells.counts[slot.label];
        }
    }
    return cells;
}

}  // namespace pcbench
