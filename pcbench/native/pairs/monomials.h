// Monomials of three variables, by which displacement fields are described.
#pragma once
#include <cstddef>
#include <cstdint>

namespace pcbench {

constexpr size_t kMonomials = 20;  // monomials up to degree three
constexpr size_t kProducts = 84;   // monomials up to degree six, which include all products of two of the former
constexpr size_t kMaxWholePairs = size_t{1} << 20;  // whose sums in whole numbers fit into 63 bits

// Each monomial but the first is an earlier one times the coordinate of an axis.
struct MonomialStep {
    int64_t earlier, axis;
};

}  // namespace pcbench
