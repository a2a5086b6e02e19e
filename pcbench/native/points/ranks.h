// Ranks of keys, counted with many comparisons at a time: the fastest way to sort up to about a hundred of them.
// Included once per instruction set, see kernels_isa.h.
#pragma once
#include <cstddef>
#include <cstdint>

namespace pcbench::PCB_ISA {

constexpr size_t kRanksPerPass = 16;  // ranks counted simultaneously

// Writes the ranks of kRanksPerPass of the keys, from `some` on: the number of keys that are lower.
inline void count_ranks(const int32_t* keys, size_t count, const int32_t* some, int32_t* ranks) {
    int32_t rank[kRanksPerPass] = {};
    for (size_t j = 0; j < count; ++j)
        for (size_t i = 0; i < kRanksPerPass; ++i) rank[i] += keys[j] < some[i];
    for (size_t i = 0; i < kRanksPerPass; ++i) ranks[i] = rank[i];
}

}  // namespace pcbench::PCB_ISA
