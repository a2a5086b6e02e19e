// The compiled core: loops over points that numpy cannot fuse. They use no Python objects and release the GIL.
#include <nanobind/stl/optional.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <utility>
#include <vector>

#include "common/arrays.h"
#include "common/forked.h"
#include "common/interruptible.h"
#include "mesh/mesh_module.h"
#include "pairs/loops_module.h"
#include "points/index.h"
#include "points/thread_scratch.h"

namespace {

using Flags = Out<bool, nb::shape<-1>>;

constexpr const char* kBadCoordinate = "expected finite coordinates up to 1e100";

// Queries are sorted in batches of this size, which bounds the memory.
constexpr size_t kQueryBatch = size_t{1} << 20;

// Transfers ownership of the memory to numpy.
auto to_numpy(pcbench::Block<int64_t> block, size_t count) {
    int64_t* data = block.release();
    return nb::ndarray<nb::numpy, int64_t, nb::ndim<1>>(
        data, {count}, nb::capsule(data, [](void* p) noexcept { pcbench::AlignedFree()(p); }));
}

class PointIndex {
public:
    explicit PointIndex(Points points) : points_(points) {
        check(points.shape(0) > 0 && points.shape(0) < pcbench::kNoRow, "Index: expected 1 to 2^32 - 2 points");
        pcbench::interruptible(
            [&](pcbench::Interrupt& interrupt) { index_.emplace(points_.data(), points_.shape(0), interrupt); });
        check(index_->valid(), kBadCoordinate);
    }

    // An index whose tree was stored.
    PointIndex(Points points, Column tree) : points_(points), stored_(tree) {
        check(points.shape(0) > 0 && tree.shape(0) == pcbench::Index::doubles(points.shape(0)) &&
                  reinterpret_cast<uintptr_t>(tree.data()) % alignof(pcbench::Leaf) == 0,
              "Index: expected the stored tree of these points, at a multiple of 32 bytes");
        index_.emplace(points_.data(), points_.shape(0), tree.data());
    }

    void store(Out<double, nb::shape<-1>> tree) const {
        check(8 * tree.shape(0) == bytes(), "store: expected an array of as many bytes as the tree has");
        index_->copy_to(tree.data());
    }

    const pcbench::Tree& tree() const { return index_->tree(); }
    size_t bytes() const { return index_->bytes(); }

    void nearest(Points queries, std::optional<Indices> hints, Out<double, nb::shape<-1>> distances,
                 Out<int64_t, nb::shape<-1>> indices) const {
        const size_t count = queries.shape(0);
        check(distances.shape(0) == count && indices.shape(0) == count, "nearest: expected one row per query");
        if (hints) {
            check(hints->shape(0) == count, "nearest: expected one hint per query");
            check_rows(*hints, "nearest: expected hints that are indices of points");
        }
        for_query_batches(
            queries, [&](const pcbench::SortedPoints& batch, size_t offset, pcbench::Interrupt& interrupt) {
                pcbench::kernels().nearest(tree(), batch.leaves.get(), batch.leaf_count,
                                           hints ? hints->data() + offset : nullptr, false, distances.data() + offset,
                                           indices.data() + offset, {}, interrupt);
            });
    }

    void nearest_of(const PointIndex& queries, Out<double, nb::shape<-1>> distances,
                    Out<int64_t, nb::shape<-1>> indices, double slack, std::optional<Flags> tied) const {
        const pcbench::Tree& query_tree = queries.tree();
        check(distances.shape(0) == query_tree.count && indices.shape(0) == query_tree.count,
              "nearest_of: expected one row per query");
        check(!tied || tied->shape(0) == query_tree.count, "nearest_of: expected one flag per query");
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            pcbench::kernels().nearest(tree(), query_tree.leaves, query_tree.leaf_count, nullptr, &queries == this,
                                       distances.data(), indices.data(), {slack, tied ? tied->data() : nullptr},
                                       interrupt);
        });
    }

    // `motion` holds the first three rows of a homogeneous matrix.
    void nearest_of_moved(const PointIndex& queries, In<double, nb::shape<3, 4>> motion, std::optional<Indices> hints,
                          Out<double, nb::shape<-1, 3>> moved, Out<double, nb::shape<-1>> distances,
                          Out<int64_t, nb::shape<-1>> indices) const {
        const pcbench::Tree& query_tree = queries.tree();
        check(moved.shape(0) == query_tree.count && distances.shape(0) == query_tree.count &&
                  indices.shape(0) == query_tree.count,
              "nearest_of_moved: expected one row per query");
        if (hints) {
            check(hints->shape(0) == query_tree.count, "nearest_of_moved: expected one hint per query");
            check_rows(*hints, "nearest_of_moved: expected hints that are indices of points");
        }
        bool valid = true;
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            const pcbench::Block<pcbench::Leaf> leaves = pcbench::allocate<pcbench::Leaf>(query_tree.leaf_count);
            valid = transform_leaves(query_tree, motion.data(), leaves.get(), moved.data());
            if (!valid) return;
            pcbench::kernels().nearest(tree(), leaves.get(), query_tree.leaf_count, hints ? hints->data() : nullptr,
                                       false, distances.data(), indices.data(), {}, interrupt);
        });
        check(valid, kBadCoordinate);
    }

    // As nearest_of_moved, with what earlier calls have found, which is updated.
    void follow(const PointIndex& queries, In<double, nb::shape<3, 4>> motion, Out<double, nb::shape<-1, 3>> places,
                Out<int64_t, nb::shape<-1>> indices, Out<double, nb::shape<-1>> clearances,
                Out<double, nb::shape<-1, 3>> moved, Out<double, nb::shape<-1>> distances) const {
        const pcbench::Tree& query_tree = queries.tree();
        const size_t count = query_tree.count;
        check(places.shape(0) == count && indices.shape(0) == count && clearances.shape(0) == count &&
                  moved.shape(0) == count && distances.shape(0) == count,
              "follow: expected one row per query");
        for (size_t i = 0; i < count; ++i)
            check(!(clearances.data()[i] > 0) || static_cast<uint64_t>(indices.data()[i]) < tree().count,
                  "follow: expected matches that are indices of points");
        bool valid = true;
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            const pcbench::Block<pcbench::Leaf> leaves = pcbench::allocate<pcbench::Leaf>(query_tree.leaf_count);
            valid = transform_leaves(query_tree, motion.data(), leaves.get(), moved.data());
            if (!valid) return;
            pcbench::kernels().follow(tree(), leaves.get(), query_tree.leaf_count,
                                      {places.data(), indices.data(), clearances.data()}, distances.data(), interrupt);
        });
        check(valid, kBadCoordinate);
    }

    void knearest(Points queries, Out<double, nb::ndim<2>> distances, Out<int64_t, nb::ndim<2>> indices) const {
        const size_t count = queries.shape(0), k = distances.shape(1);
        check(distances.shape(0) == count && indices.shape(0) == count && indices.shape(1) == k,
              "knearest: expected one row per query and k columns");
        check(k > 0 && k <= tree().count, "knearest: expected k from 1 to the number of points");
        const pcbench::Kernels& kernels = pcbench::kernels();
        const pcbench::ThreadScratch scratch(kernels.knearest_scratch_bytes(k));
        for_query_batches(
            queries, [&](const pcbench::SortedPoints& batch, size_t offset, pcbench::Interrupt& interrupt) {
                kernels.knearest(tree(), batch.leaves.get(), batch.leaf_count, k, distances.data() + k * offset,
                                 indices.data() + k * offset, scratch.data(), interrupt);
            });
    }

    nb::tuple in_balls(Points centres, double radius) const {
        return query_regions(centres, [&](const pcbench::SortedPoints& sorted, int64_t* offsets, int64_t* rows,
                                          pcbench::Interrupt& interrupt) {
            pcbench::kernels().in_balls(tree(), sorted.leaves.get(), sorted.leaf_count, radius, offsets, rows,
                                        interrupt);
        });
    }

    void count_near(const PointIndex& queries, In<double, nb::ndim<2>> limits, Out<int64_t, nb::ndim<2>> counts) const {
        const pcbench::Tree& query_tree = queries.tree();
        const size_t limit_count = limits.shape(1);
        check(limits.shape(0) == query_tree.count && counts.shape(0) == query_tree.count &&
                  counts.shape(1) == limit_count && limit_count <= pcbench::kMostLimits,
              "count_near: expected one row per query, of at most 8 distances");
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            pcbench::kernels().count_near(tree(), query_tree.leaves, query_tree.leaf_count, limits.data(), limit_count,
                                          counts.data(), interrupt);
        });
    }

    nb::tuple in_cylinders(Points origins, Points axes, double radius, double half_length) const {
        check(axes.shape(0) == origins.shape(0), "in_cylinders: expected one axis per origin");
        return query_regions(origins, [&](const pcbench::SortedPoints& sorted, int64_t* offsets, int64_t* rows,
                                          pcbench::Interrupt& interrupt) {
            pcbench::kernels().in_cylinders(tree(), sorted.leaves.get(), sorted.leaf_count, axes.data(), radius,
                                            half_length, offsets, rows, interrupt);
        });
    }

    void planes(size_t k, std::optional<Indices> rows, Out<double, nb::shape<-1, 3>> normals,
                Out<double, nb::shape<-1>> variation, Out<double, nb::shape<-1>> distances,
                Out<int64_t, nb::shape<-1>> indices, Out<double, nb::shape<-1>> reach) const {
        const size_t count = rows ? rows->shape(0) : tree().count;
        check(normals.shape(0) == count && variation.shape(0) == count && distances.shape(0) == count &&
                  indices.shape(0) == count && reach.shape(0) == count,
              "planes: expected one row per requested point");
        check(k > 1 && k <= tree().count, "planes: expected k from 2 to the number of points");
        pcbench::Block<double> selected_points;
        if (rows) {
            check_rows(*rows, "planes: expected rows that are indices of points");
            selected_points = pcbench::allocate<double>(3 * count);
            for (size_t i = 0; i < count; ++i)
                std::copy_n(tree().points + 3 * rows->data()[i], 3, selected_points.get() + 3 * i);
        }
        const pcbench::Kernels& kernels = pcbench::kernels();
        const pcbench::ThreadScratch scratch(kernels.plane_scratch_bytes(k));
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            const auto fit = [&](const pcbench::Leaf* queries, size_t leaf_count) {
                kernels.planes(tree(), queries, leaf_count, rows ? rows->data() : nullptr, k, normals.data(),
                               variation.data(), distances.data(), indices.data(), reach.data(), scratch.data(),
                               interrupt);
            };
            if (!rows) return fit(tree().leaves, tree().leaf_count);
            if (count == 0) return;
            const pcbench::SortedPoints sorted(selected_points.get(), count, interrupt);
            if (!interrupt.requested()) fit(sorted.leaves.get(), sorted.leaf_count);
        });
    }

private:
    // A motion preserves neighbourhoods, so the sorted leaves are reused.
    static bool transform_leaves(const pcbench::Tree& query_tree, const double* m, pcbench::Leaf* leaves,
                                 double* moved) {
        bool valid = true;
#pragma omp parallel for schedule(static) reduction(&& : valid) if (query_tree.leaf_count > 1024)
        for (size_t l = 0; l < query_tree.leaf_count; ++l) {
            const pcbench::Leaf& leaf = query_tree.leaves[l];
            leaves[l] = leaf;
            double* axes[3] = {leaves[l].x, leaves[l].y, leaves[l].z};
            for (size_t i = 0; i < pcbench::kFanout && leaf.row[i] != pcbench::kNoRow; ++i)
                for (int a = 0; a < 3; ++a) {
                    const double v =
                        ((m[4 * a] * leaf.x[i] + m[4 * a + 1] * leaf.y[i]) + m[4 * a + 2] * leaf.z[i]) + m[4 * a + 3];
                    axes[a][i] = moved[3 * static_cast<size_t>(leaf.row[i]) + a] = v;
                    valid = valid && std::fabs(v) <= pcbench::kCoordinateLimit;
                }
        }
        return valid;
    }

    void check_rows(Indices rows, const char* message) const {
        for (size_t i = 0; i < rows.shape(0); ++i)
            check(rows.data()[i] >= 0 && static_cast<size_t>(rows.data()[i]) < tree().count, message);
    }

    // The search runs twice, to count and then to fill, so that memory is allocated once with the exact size.
    template <typename Search>
    nb::tuple query_regions(Points queries, Search search) const {
        const size_t count = queries.shape(0);
        pcbench::Block<int64_t> offsets = pcbench::allocate<int64_t>(count + 1), rows;
        offsets[0] = 0;
        bool valid = true;
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            if (count == 0) return;
            const pcbench::SortedPoints sorted(queries.data(), count, interrupt);
            valid = sorted.valid;
            if (!valid || interrupt.requested()) return;
            search(sorted, offsets.get(), nullptr, interrupt);
            if (interrupt.requested()) return;
            for (size_t i = 0; i < count; ++i) offsets[i + 1] += offsets[i];
            rows = pcbench::allocate<int64_t>(offsets[count]);
            search(sorted, offsets.get(), rows.get(), interrupt);
            if (interrupt.requested()) return;
#pragma omp parallel for schedule(dynamic, 256)
            for (size_t i = 0; i < count; ++i) std::sort(rows.get() + offsets[i], rows.get() + offsets[i + 1]);
        });
        check(valid, kBadCoordinate);
        const size_t found = offsets[count];
        return nb::make_tuple(to_numpy(std::move(offsets), count + 1), to_numpy(std::move(rows), found));
    }

    template <typename Search>
    void for_query_batches(Points queries, Search search) const {
        bool valid = true;
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            for (size_t offset = 0; offset < queries.shape(0); offset += kQueryBatch) {
                const size_t count = std::min(kQueryBatch, queries.shape(0) - offset);
                const pcbench::SortedPoints batch(queries.data() + 3 * offset, count, interrupt);
                valid = valid && batch.valid;
                if (!valid || interrupt.requested()) return;
                search(batch, offset, interrupt);
            }
        });
        check(valid, kBadCoordinate);
    }

    Points points_;  // keeps the caller's array alive
    std::optional<Column> stored_;
    std::optional<pcbench::Index> index_;
};

}  // namespace

NB_MODULE(_core, m) {
    m.doc() = "Compiled kernels of pcbench; use the Python modules that wrap them.";
    pcbench::one_thread_when_forked();

    m.def("isa", [] { return pcbench::kernels().name; }, "The instruction set in use: baseline, avx2 or avx512.");

    nb::class_<PointIndex>(m, "PointIndex", "A search tree over points. Results are written into the given arrays.")
        .def(nb::init<Points>(), nb::arg("points").noconvert())
        .def(nb::init<Points, Column>(), nb::arg("points").noconvert(), nb::arg("tree").noconvert(),
             "The index of these points whose tree was stored.")
        .def("store", &PointIndex::store, nb::arg("tree").noconvert(),
             "Write the tree into an array of as many bytes as it has.")
        .def_prop_ro("bytes", &PointIndex::bytes, "Memory of the tree in bytes, without the points.")
        .def("nearest", &PointIndex::nearest, nb::arg("queries").noconvert(), nb::arg("hints").noconvert().none(),
             nb::arg("distances").noconvert(), nb::arg("indices").noconvert())
        .def("nearest_of", &PointIndex::nearest_of, nb::arg("queries"), nb::arg("distances").noconvert(),
             nb::arg("indices").noconvert(), nb::arg("slack") = 0.0, nb::arg("tied").noconvert().none() = nb::none(),
             "Nearest points to the points of another index, or of this one (no point is then its own neighbour). tied:"
             " whether another point than the match has a squared distance below the match's plus "
             "slack.")
        .def("nearest_of_moved", &PointIndex::nearest_of_moved, nb::arg("queries"), nb::arg("motion").noconvert(),
             nb::arg("hints").noconvert().none(), nb::arg("moved").noconvert(), nb::arg("distances").noconvert(),
             nb::arg("indices").noconvert(), "Nearest points to the points of another index after a motion (3, 4).")
        .def("follow", &PointIndex::follow, nb::arg("queries"), nb::arg("motion").noconvert(),
             nb::arg("places").noconvert(), nb::arg("indices").noconvert(), nb::arg("clearances").noconvert(),
             nb::arg("moved").noconvert(), nb::arg("distances").noconvert(),
             "Nearest points to the points of another index after a motion (3, 4). Places (M, 3) and indices (M,) are"
             " those of the last search of each query, and clearances (M,) the distances of its second nearest point"
             " then, 0 before any; they are updated in place.")
        .def("knearest", &PointIndex::knearest, nb::arg("queries").noconvert(), nb::arg("distances").noconvert(),
             nb::arg("indices").noconvert())
        .def("planes", &PointIndex::planes, nb::arg("k"), nb::arg("rows").noconvert().none(),
             nb::arg("normals").noconvert(), nb::arg("variation").noconvert(), nb::arg("distances").noconvert(),
             nb::arg("indices").noconvert(), nb::arg("reach").noconvert(),
             "Planes through the k nearest points of each point, or of those in rows, the point itself included, with"
             " normals oriented upwards, the nearest other point, and the distance of the k-th nearest point.")
        .def("in_balls", &PointIndex::in_balls, nb::arg("centres").noconvert(), nb::arg("radius"),
             "Offsets (N + 1,) and the indices of points, ascending for each ball.",
             nb::sig("def in_balls(self, centres: NDArray[numpy.float64], radius: float) -> "
                     "tuple[NDArray[numpy.int64], NDArray[numpy.int64]]"))
        .def("count_near", &PointIndex::count_near, nb::arg("queries"), nb::arg("limits").noconvert(),
             nb::arg("counts").noconvert(),
             "Numbers of points (M, S) within distances (M, S) of the points of another index.")
        .def("in_cylinders", &PointIndex::in_cylinders, nb::arg("origins").noconvert(), nb::arg("axes").noconvert(),
             nb::arg("radius"), nb::arg("half_length"),
             "Offsets (N + 1,) and the indices of points, ascending for each cylinder.",
             nb::sig("def in_cylinders(self, origins: NDArray[numpy.float64], axes: NDArray[numpy.float64], radius: "
                     "float, half_length: float) -> tuple[NDArray[numpy.int64], NDArray[numpy.int64]]"));

    bind_loops(m);
    bind_mesh(m);
}
