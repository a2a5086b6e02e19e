// Sums over pairs of points.
#include "pairs/pairs.h"

#include "golden.h"
#include "pairs/exact_sums.h"
#include "points/kernels.h"

void golden::pairs() {
    constexpr size_t kCount = 5000;
    Random random(4);
    std::vector<double> moved, closest, normals, distances;
    for (size_t i = 0; i < kCount; ++i) {
        const double slope = random.uniform(-1, 2) / 4, length = std::sqrt(1 + slope * slope);
        for (int axis = 0; axis < 3; ++axis) {
            closest.push_back(random.uniform(0, 16));
            moved.push_back(closest.back() + random.uniform(-1, 2) / 8);
        }
        normals.insert(normals.end(), {slope / length, 0.0, 1 / length});
        distances.push_back(random.uniform(0, 2));
    }
    const pcbench::Rows closest_rows{closest.data(), nullptr}, normal_rows{normals.data(), nullptr};
    std::vector<double> residuals(kCount), weights(kCount), sums;
    for (const bool robust : {false, true}) {
        const pcbench::WeightSummary summary =
            pcbench::weigh(kCount, moved.data(), distances.data(), closest_rows, normal_rows, 1.5, robust, 0.75,
                           residuals.data(), weights.data());
        sums = {static_cast<double>(summary.pairs_in_range), summary.sigma};
        Hash(robust ? "weigh_robust" : "weigh_trimmed").add(residuals).add(weights).add(sums);
    }
    const pcbench::PlaneSystem system =
        pcbench::plane_system(kCount, moved.data(), normal_rows, residuals.data(), weights.data());
    sums.assign(&system.hessian[0][0], &system.hessian[0][0] + 49);
    sums.insert(sums.end(), system.gradient, system.gradient + 7);
    sums.insert(sums.end(), system.center, system.center + 3);
    sums.push_back(system.radius);
    Hash("plane_system").add(sums);
    pcbench::rounded_squares(kCount, {moved.data(), nullptr}, closest_rows, distances.data());
    Hash("rounded_squares").add(distances);
    std::vector<pcbench::MonomialStep> steps;
    for (int64_t a = 0; a + 1 < static_cast<int64_t>(pcbench::kProducts); ++a) steps.push_back({a / 3, a % 3});
    std::vector<double> moments(pcbench::kProducts * 6), scores(pcbench::kMonomials * 3);
    pcbench::kernels().normal_equations(0, kCount, moved.data(), normals.data(), weights.data(), residuals.data(),
                                        steps.data(), moments.data(), scores.data());
    Hash("normal_equations").add(moments).add(scores);
    std::vector<int64_t> groups;
    std::vector<uint32_t> limbs(3 * pcbench::kLimbs);
    for (size_t i = 0; i < kCount; ++i) groups.push_back(static_cast<int64_t>(i % 3));
    pcbench::add_exactly(kCount, residuals.data(), groups.data(), limbs.data());
    Hash("add_exactly").add(limbs);
    sums.clear();
    for (size_t g = 0; g < 3; ++g) sums.push_back(pcbench::round_exactly(limbs.data() + pcbench::kLimbs * g));
    Hash("round_exactly").add(sums);
}
