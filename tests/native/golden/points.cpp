// The search tree: nearest points, neighbourhoods, planes through them, and cells.
#include <algorithm>

#include "golden.h"
#include "points/cells.h"
#include "points/index.h"
#include "points/normals.h"
#include "points/thread_scratch.h"

namespace {

bool no_interrupt() { return false; }

// A rough plane far from the origin. Every fourth point duplicates an earlier one, so that ties are resolved by row.
std::vector<double> make_cloud(size_t count, uint64_t seed) {
    golden::Random random(seed);
    std::vector<double> points(3 * count);
    for (size_t i = 0; i < count; ++i) {
        const size_t earlier = i % 4 == 3 ? static_cast<size_t>(random.below(static_cast<uint32_t>(i))) : i;
        for (int axis = 0; axis < 3; ++axis)
            points[3 * i + axis] =
                earlier < i ? points[3 * earlier + axis] : 400000 + random.uniform(0, axis < 2 ? 64 : 1);
    }
    return points;
}

}  // namespace

void golden::points() {
    constexpr size_t kCount = 20000, kQueries = 3000, kNeighbors = 12;
    const std::vector<double> cloud = make_cloud(kCount, 1), queries = make_cloud(kQueries, 2);
    pcbench::Interrupt interrupt(no_interrupt);
    const pcbench::Index index(cloud.data(), kCount, interrupt);
    const pcbench::Tree& tree = index.tree();
    const pcbench::SortedPoints sorted(queries.data(), kQueries, interrupt);
    const pcbench::Kernels& kernels = pcbench::kernels();

    std::vector<double> distances(kQueries);
    std::vector<int64_t> rows(kQueries);
    kernels.nearest(tree, sorted.leaves.get(), sorted.leaf_count, nullptr, false, distances.data(), rows.data(), {},
                    interrupt);
    Hash("nearest").add(distances).add(rows);

    std::vector<double> places(3 * kQueries), clearances(kQueries);
    for (int step = 0; step < 2; ++step) {  // the second one does not search
        kernels.follow(tree, sorted.leaves.get(), sorted.leaf_count, {places.data(), rows.data(), clearances.data()},
                       distances.data(), interrupt);
        Hash(step == 0 ? "follow_first" : "follow_again").add(distances).add(rows).add(places).add(clearances);
    }

    std::vector<double> all_distances(kQueries * kNeighbors);
    std::vector<int64_t> neighbors(kQueries * kNeighbors);
    const auto search_neighbors = [&](size_t k, double* to_neighbors, int64_t* indices) {
        const pcbench::ThreadScratch scratch(kernels.knearest_scratch_bytes(k));
        kernels.knearest(tree, sorted.leaves.get(), sorted.leaf_count, k, to_neighbors, indices, scratch.data(),
                         interrupt);
    };
    search_neighbors(kNeighbors, all_distances.data(), neighbors.data());
    Hash("knearest").add(all_distances).add(neighbors);
    for (const size_t k : {size_t{3}, size_t{320}}) {  // by a sorted list, and by a buffer of each query
        std::vector<double> to_neighbors(kQueries * k);
        std::vector<int64_t> indices(kQueries * k);
        search_neighbors(k, to_neighbors.data(), indices.data());
        Hash(k == 3 ? "knearest_few" : "knearest_many").add(to_neighbors).add(indices);
    }

    std::vector<double> normals(3 * kQueries), variation(kQueries);
    pcbench::plane_fits(cloud.data(), kCount, neighbors.data(), kQueries, kNeighbors, normals.data(), variation.data());
    Hash("plane_fits").add(normals).add(variation);

    std::vector<double> axes;
    for (size_t i = 0; i < kQueries; ++i) axes.insert(axes.end(), {0.0, 0.6, 0.8});
    const auto hash_neighborhoods = [&](const char* name, const auto& search) {
        std::vector<int64_t> offsets(kQueries + 1);
        search(offsets.data(), static_cast<int64_t*>(nullptr));
        for (size_t i = 0; i < kQueries; ++i) offsets[i + 1] += offsets[i];
        std::vector<int64_t> indices(static_cast<size_t>(offsets.back()));
        search(offsets.data(), indices.data());
        for (size_t i = 0; i < kQueries; ++i) std::sort(indices.begin() + offsets[i], indices.begin() + offsets[i + 1]);
        Hash(name).add(offsets).add(indices);
    };
    hash_neighborhoods("in_balls", [&](int64_t* offsets, int64_t* indices) {
        kernels.in_balls(tree, sorted.leaves.get(), sorted.leaf_count, 1.25, offsets, indices, interrupt);
    });
    hash_neighborhoods("in_cylinders", [&](int64_t* offsets, int64_t* indices) {
        kernels.in_cylinders(tree, sorted.leaves.get(), sorted.leaf_count, axes.data(), 1.25, 0.5, offsets, indices,
                             interrupt);
    });

    std::vector<double> limits;
    for (size_t i = 0; i < kQueries; ++i) limits.insert(limits.end(), {0.25, 1.25});
    std::vector<int64_t> within(2 * kQueries);
    kernels.count_near(tree, sorted.leaves.get(), sorted.leaf_count, limits.data(), 2, within.data(), interrupt);
    Hash("count_near").add(within);

    const pcbench::ThreadScratch scratch(kernels.plane_scratch_bytes(16));
    std::vector<double> reach(kCount);
    normals.resize(3 * kCount), variation.resize(kCount), distances.resize(kCount), rows.resize(kCount);
    kernels.planes(tree, tree.leaves, tree.leaf_count, nullptr, 16, normals.data(), variation.data(), distances.data(),
                   rows.data(), reach.data(), scratch.data(), interrupt);
    Hash("planes").add(normals).add(variation).add(distances).add(rows).add(reach);

    const double lower[3] = {400000, 400000, 400000};
    const pcbench::OccupiedCells occupied =
        pcbench::group_by_cell(cloud.data(), kCount, pcbench::Grid(0.7, lower), nullptr, rows.data());
    Hash("group_by_cell").add(rows).add(occupied.first).add(occupied.counts);
}
