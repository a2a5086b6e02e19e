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

}  // namespace pcbench::PCB_ISA
