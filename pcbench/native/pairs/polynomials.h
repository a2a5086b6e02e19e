// Sums in the normal equations of a polynomial displacement field. Included once per instruction set, see
// points/kernels_isa.h.
#pragma once
#include "common/simd.h"
#include "pairs/monomials.h"

namespace pcbench::PCB_ISA {

// Adds the pairs in [begin, end), in their order, to moments (84, 6), sums of w phi n n', and scores (20, 3), sums of
// w phi n r.
inline void normal_equations(size_t begin, size_t end, const double* positions, const double* normals,
                             const double* weights, const double* residuals, const MonomialStep* steps, double* moments,
                             double* scores) {
    constexpr size_t kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
    // The lanes of a sum are the six moments and two of the scores, those of a factor one pair's products with a
    // monomial. Monomials of several pairs are computed at once, with pairs as lanes.
    static_assert(kLanes == 8, "the lanes are six moments and two scores");
    Vector sums[kProducts];
    double third[kMonomials];  // the third score
    for (size_t a = 0; a < kProducts; ++a) {
        double lanes[kLanes] = {};
        for (size_t k = 0; k < 6; ++k) lanes[k] = moments[6 * a + k];
        for (size_t k = 0; k < 2 && a < kMonomials; ++k) lanes[6 + k] = scores[3 * a + k];
        sums[a] = load(lanes);
    }
    for (size_t a = 0; a < kMonomials; ++a) third[a] = scores[3 * a + 2];
    for (size_t start = begin; start < end; start += kLanes) {
        const size_t count = min_size(kLanes, end - start);
        double values[kProducts][kLanes], coordinates[3][kLanes] = {}, third_factors[kLanes];
        Vector factors[kLanes];
        for (size_t p = 0; p < count; ++p) {
            const double *x = positions + 3 * (start + p), *n = normals + 3 * (start + p), w = weights[start + p];
            const double weighted = w * residuals[start + p];
            double lanes[kLanes];
            for (size_t k = 0; k < 6; ++k) lanes[k] = w * n[kRow[k]] * n[kColumn[k]];
            for (size_t k = 0; k < 2; ++k) lanes[6 + k] = n[k] * weighted;
            factors[p] = load(lanes);
            third_factors[p] = n[2] * weighted;
            for (size_t axis = 0; axis < 3; ++axis) coordinates[axis][p] = x[axis];
        }
        store(values[0], splat(1.0));
        for (size_t a = 1; a < kProducts; ++a)
            store(values[a], load(values[steps[a - 1].earlier]) * load(coordinates[steps[a - 1].axis]));
        for (size_t a = 0; a < kProducts; ++a) {
            Vector sum = sums[a];
            for (size_t p = 0; p < count; ++p) sum = sum + splat(values[a][p]) * factors[p];
            sums[a] = sum;
        }
        for (size_t a = 0; a < kMonomials; ++a)
            for (size_t p = 0; p < count; ++p) third[a] += values[a][p] * third_factors[p];
    }
    for (size_t a = 0; a < kProducts; ++a) {
        double lanes[kLanes];
        store(lanes, sums[a]);
        for (size_t k = 0; k < 6; ++k) moments[6 * a + k] = lanes[k];
        if (a >= kMonomials) continue;
        for (size_t k = 0; k < 2; ++k) scores[3 * a + k] = lanes[6 + k];
        scores[3 * a + 2] = third[a];
    }
}

constexpr size_t kPairsAtOnce = 64;
constexpr size_t kExactPairs = kLanes * 4096;  // each lane adds at most 4,096 pairs of products below 2^40: exactly
constexpr double kDigit = 1 << 20;             // base of digits

// The nearest whole numbers, ties to even. A double of 2^52 or more is whole.
inline Vector rounded(Vector x) {
    const Vector shift = splat(1.5 * (int64_t{1} << 52));
    return select(abs(x) < splat(int64_t{1} << 51), (x + shift) - shift, x);
}

// Values in units of 2^-40 as digits, the lowest one first; all but the last lie in [-2^19, 2^19].
template <size_t kDigits>
inline void split(Vector values, double (&digits)[kDigits][kPairsAtOnce], size_t place) {
    Vector rest = rounded(values * splat(kDigit * kDigit));
    for (size_t d = 0; d + 1 < kDigits; ++d) {
        const Vector higher = rounded(rest * splat(1 / kDigit));
        store(digits[d] + place, rest - higher * splat(kDigit));
        rest = higher;
    }
    store(digits[kDigits - 1] + place, rest);
}

// Adds the products of numbers, digit by digit, to the lanes of sums.
template <size_t kLeft, size_t kRight>
inline void add_products(const double (&left)[kLeft][kPairsAtOnce], const double (&right)[kRight][kPairsAtOnce],
                         double (&sums)[kLeft + kRight - 1][kLanes]) {
    Vector sum[kLeft + kRight - 1];
    for (size_t d = 0; d < kLeft + kRight - 1; ++d) sum[d] = load(sums[d]);
    for (size_t p = 0; p < kPairsAtOnce; p += kLanes)
        for (size_t i = 0; i < kLeft; ++i)
            for (size_t j = 0; j < kRight; ++j) sum[i + j] = sum[i + j] + load(left[i] + p) * load(right[j] + p);
    for (size_t d = 0; d < kLeft + kRight - 1; ++d) store(sums[d], sum[d]);
}

template <size_t kDigits>
inline void add_lanes(const double (&sums)[kDigits][kLanes], int64_t* digits, size_t stride) {
    for (size_t d = 0; d < kDigits; ++d)
        for (size_t l = 0; l < kLanes; ++l) digits[stride * d] += static_cast<int64_t>(sums[d][l]);
}

// For pairs of equal weight: moments (3, 84, 6) and scores (4, 20, 3) in whole numbers, to which the pairs are added in
// any order with the same result. Monomials, products n n' and n r are rounded to multiples of 2^-40; the sums of their
// products have units of 2^-80 and digits of base 2^20, the lowest one first, which may be negative.
inline void whole_normal_equations(size_t count, const double* positions, const double* normals,
                                   const double* residuals, const MonomialStep* steps, int64_t* moments,
                                   int64_t* scores) {
    constexpr size_t kRow[6] = {0, 1, 2, 0, 0, 1}, kColumn[6] = {0, 1, 2, 1, 2, 2};
    double monomials[kProducts][2][kPairsAtOnce], products[6][2][kPairsAtOnce], loads[3][3][kPairsAtOnce];
    double moment_lanes[kProducts][6][3][kLanes], score_lanes[kMonomials][3][4][kLanes];
    for (size_t begin = 0; begin < count; begin += kExactPairs) {
        const size_t end = min_size(begin + kExactPairs, count);
        for (size_t i = 0; i < sizeof moment_lanes / sizeof(double); ++i) (&moment_lanes[0][0][0][0])[i] = 0.0;
        for (size_t i = 0; i < sizeof score_lanes / sizeof(double); ++i) (&score_lanes[0][0][0][0])[i] = 0.0;
        for (size_t start = begin; start < end; start += kPairsAtOnce) {
            for (size_t place = 0; place < kPairsAtOnce; place += kLanes) {
                double x[3][kLanes] = {}, n[3][kLanes] = {}, r[kLanes] = {};  // missing pairs have no normal
                for (size_t l = 0; l < kLanes && start + place + l < end; ++l) {
                    const size_t pair = start + place + l;
                    for (size_t axis = 0; axis < 3; ++axis)
                        x[axis][l] = positions[3 * pair + axis], n[axis][l] = normals[3 * pair + axis];
                    r[l] = residuals[pair];
                }
                Vector values[kProducts];
                values[0] = splat(1.0);
                for (size_t a = 1; a < kProducts; ++a)
                    values[a] = values[steps[a - 1].earlier] * load(x[steps[a - 1].axis]);
                for (size_t a = 0; a < kProducts; ++a) split(values[a], monomials[a], place);
                for (size_t k = 0; k < 6; ++k) split(load(n[kRow[k]]) * load(n[kColumn[k]]), products[k], place);
                for (size_t k = 0; k < 3; ++k) split(load(r) * load(n[k]), loads[k], place);
            }
            for (size_t a = 0; a < kProducts; ++a)
                for (size_t k = 0; k < 6; ++k) add_products(monomials[a], products[k], moment_lanes[a][k]);
            for (size_t a = 0; a < kMonomials; ++a)
                for (size_t k = 0; k < 3; ++k) add_products(monomials[a], loads[k], score_lanes[a][k]);
        }
        for (size_t a = 0; a < kProducts; ++a)
            for (size_t k = 0; k < 6; ++k) add_lanes(moment_lanes[a][k], moments + 6 * a + k, 6 * kProducts);
        for (size_t a = 0; a < kMonomials; ++a)
            for (size_t k = 0; k < 3; ++k) add_lanes(score_lanes[a][k], scores + 3 * a + k, 3 * kMonomials);
    }
}

}  // namespace pcbench::PCB_ISA
