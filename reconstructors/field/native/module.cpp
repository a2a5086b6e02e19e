// Python bindings of the voxel radiance field.
#include <omp.h>

#include <algorithm>
#include <vector>

#include "common/arrays.h"
#include "common/choose_kernels.h"
#include "common/first_error.h"
#include "common/forked.h"
#include "common/interruptible.h"
#include "kernels.h"

namespace {

using namespace pcbench::field;
using Rows = In<float, nb::shape<-1, kChannels>>;
using OutRows = Out<float, nb::shape<-1, kChannels>>;
using Row = In<float, nb::shape<kChannels>>;
using Links = In<int32_t, nb::shape<-1, -1, -1>>;
using Blocks = In<uint8_t, nb::shape<-1, -1, -1>>;
using Vectors = In<float, nb::shape<-1, 3>>;
using Values = Out<float, nb::shape<-1>>;
using Colors = Out<float, nb::shape<-1, 3>>;

constexpr int kRays = 64;        // rays of one task
constexpr int64_t kRows = 4096;  // rows of one task

const Kernels& kernels() {
    static const Kernels& chosen = pcbench::choose_kernels<Kernels>({
#ifdef PCB_X86
        &avx512::kernels, &avx2::kernels,
#endif
        &baseline::kernels});
    return chosen;
}

Grid grid_of(const Rows& values, const Links& links, const Blocks& occupied, const Row& background, float step) {
    Grid grid{values.data(), links.data(), occupied.data(), {}, {}, background.data(), step};
    for (int a = 0; a < 3; ++a) {
        check(links.shape(a) >= 2 && links.shape(a) <= 4096, "expected 2 to 4096 vertices along each axis");
        grid.size[a] = static_cast<int>(links.shape(a));
        grid.blocks[a] = (grid.size[a] - 1 + kBlock - 1) / kBlock;
        check(occupied.shape(a) == static_cast<size_t>(grid.blocks[a]), "expected one entry for each block of cells");
    }
    check(links.size() <= INT32_MAX, "expected fewer than 2^31 vertices");
    check(step >= 0.01f, "expected a step of at least 0.01 voxels");
    return grid;
}

Ray ray_of(const Vectors& origins, const Vectors& directions, const float* offset, size_t at) {
    Ray ray;
    std::copy_n(origins.data() + 3 * at, 3, ray.origin);
    std::copy_n(directions.data() + 3 * at, 3, ray.direction);
    ray.offset = offset == nullptr ? 0.5f : offset[at];
    return ray;
}

void render(Rows values, Links links, Blocks occupied, Row background, float step, Vectors origins, Vectors directions,
            Colors color, Values transmittance, Values depth, Values median, Colors normal) {
    const Grid grid = grid_of(values, links, occupied, background, step);
    const size_t count = origins.shape(0);
    check(directions.shape(0) == count && color.shape(0) == count && transmittance.shape(0) == count &&
              depth.shape(0) == count && median.shape(0) == count && normal.shape(0) == count,
          "expected one row for each ray");
    kernels();
    pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
#pragma omp parallel for schedule(dynamic)
        for (size_t begin = 0; begin < count; begin += kRays) {
            if (interrupt.requested()) continue;
            for (size_t i = begin; i < std::min(begin + kRays, count); ++i) {
                Ray ray = ray_of(origins, directions, nullptr, i);
                Pixel pixel;
                kernels().trace(grid, ray, nullptr, pixel);
                std::copy_n(pixel.color, 3, color.data() + 3 * i);
                std::copy_n(pixel.normal, 3, normal.data() + 3 * i);
                transmittance.data()[i] = pixel.transmittance;
                depth.data()[i] = pixel.depth, median.data()[i] = pixel.median;
            }
        }
    });
}

// The rays of one task with their samples.
struct Task {
    std::vector<Sample> samples;
    Ray rays[kRays];
    int ends[kRays];  // end of each ray's samples
    float errors[kRays], background[kRays][3];
};

double gradients(Rows values, Links links, Blocks occupied, Row background, float step, Vectors origins,
                 Vectors directions, In<float, nb::shape<-1>> offsets, Vectors targets, OutRows gradients,
                 Out<uint8_t, nb::shape<-1>> touched, Values weights,
                 Out<float, nb::shape<kChannels>> grad_background) {
    const Grid grid = grid_of(values, links, occupied, background, step);
    const size_t count = origins.shape(0), rows = values.shape(0);
    check(directions.shape(0) == count && offsets.shape(0) == count && targets.shape(0) == count,
          "expected one row for each ray");
    check(gradients.shape(0) == rows && touched.shape(0) == rows && weights.shape(0) == rows,
          "expected one row for each vertex");
    const auto& run = kernels();
    nb::gil_scoped_release release;
    const int tasks = static_cast<int>((count + kRays - 1) / kRays);
    const size_t longest =
        static_cast<size_t>(2.0f * static_cast<float>(grid.size[0] + grid.size[1] + grid.size[2]) / step);
    std::vector<Task> all(static_cast<size_t>(tasks));
    pcbench::FirstError error;
#pragma omp parallel for schedule(dynamic)
    for (int number = 0; number < tasks; ++number)
        error.guard([&, number] {
            Task& task = all[static_cast<size_t>(number)];
            size_t used = 0;
            const size_t begin = static_cast<size_t>(number) * kRays, end = std::min(begin + kRays, count);
            for (size_t i = begin; i < end; ++i) {
                Ray& ray = task.rays[i - begin] = ray_of(origins, directions, offsets.data(), i);
                if (task.samples.size() < used + longest) task.samples.resize(2 * used + longest);
                Pixel pixel;
                Sample* samples = task.samples.data() + used;
                const int found = run.trace(grid, ray, samples, pixel);
                task.errors[i - begin] =
                    run.pull_back(ray, pixel, targets.data() + 3 * i, step, samples, found, task.background[i - begin]);
                used += static_cast<size_t>(found);
                task.ends[i - begin] = static_cast<int>(used);
            }
        });
    error.rethrow();
#pragma omp parallel
    {
        const int thread = omp_get_thread_num(), threads = omp_get_num_threads();
        for (size_t i = 0; i < count; ++i) {
            const Task& task = all[i / kRays];
            const size_t k = i % kRays;
            const int begin = k == 0 ? 0 : task.ends[k - 1];
            run.scatter(grid, task.rays[k], task.samples.data() + begin, task.ends[k] - begin, thread, threads,
                        gradients.data(), touched.data(), weights.data());
        }
    }
    double total = 0.0;
    for (size_t i = 0; i < count; ++i) {
        const Task& task = all[i / kRays];
        total += task.errors[i % kRays];
        const float *g = task.background[i % kRays], *basis = task.rays[i % kRays].basis;
        for (int c = 0; c < 12; ++c) grad_background.data()[1 + c] += basis[1 + c] * g[c % 3];
    }
    return total;
}

void update(OutRows values, OutRows moments, OutRows gradients, Out<uint8_t, nb::shape<-1>> touched,
            In<int32_t, nb::shape<-1>> vertices, Links links, Row rates, Row smoothing) {
    const size_t rows = values.shape(0);
    check(
        moments.shape(0) == rows && gradients.shape(0) == rows && touched.shape(0) == rows && vertices.shape(0) == rows,
        "expected one row for each vertex");
    Update state{values.data(), moments.data(),  gradients.data(), touched.data(), vertices.data(), links.data(), {},
                 rates.data(),  smoothing.data()};
    for (int a = 0; a < 3; ++a) state.size[a] = static_cast<int>(links.shape(a));
    const auto& run = kernels();
    nb::gil_scoped_release release;
    const int64_t count = static_cast<int64_t>(rows);
    // All rows are smoothed before the first one moves.
#pragma omp parallel for schedule(dynamic)
    for (int64_t begin = 0; begin < count; begin += kRows) run.smooth(state, begin, std::min(begin + kRows, count));
#pragma omp parallel for schedule(dynamic)
    for (int64_t begin = 0; begin < count; begin += kRows) run.descend(state, begin, std::min(begin + kRows, count));
}

}  // namespace

NB_MODULE(_field, m) {
    m.doc() = "The compiled voxel radiance field; call it through reconstructors.field.";
    pcbench::one_thread_when_forked();

    m.def("isa", [] { return kernels().name; }, "The instruction set in use: baseline, avx2 or avx512.");
    m.def("render", &render, nb::arg("values").noconvert(), nb::arg("links").noconvert(),
          nb::arg("occupied").noconvert(), nb::arg("background").noconvert(), nb::arg("step"),
          nb::arg("origins").noconvert(), nb::arg("directions").noconvert(), nb::arg("color").noconvert(),
          nb::arg("transmittance").noconvert(), nb::arg("depth").noconvert(), nb::arg("median").noconvert(),
          nb::arg("normal").noconvert(), "Renders rays; lengths are in voxels, distances along the rays.");
    m.def("gradients", &gradients, nb::arg("values").noconvert(), nb::arg("links").noconvert(),
          nb::arg("occupied").noconvert(), nb::arg("background").noconvert(), nb::arg("step"),
          nb::arg("origins").noconvert(), nb::arg("directions").noconvert(), nb::arg("offsets").noconvert(),
          nb::arg("targets").noconvert(), nb::arg("gradients").noconvert(), nb::arg("touched").noconvert(),
          nb::arg("weights").noconvert(), nb::arg("grad_background").noconvert(),
          "Adds the gradients of the squared color errors of rays, and returns the sum of these errors.");
    m.def("update", &update, nb::arg("values").noconvert(), nb::arg("moments").noconvert(),
          nb::arg("gradients").noconvert(), nb::arg("touched").noconvert(), nb::arg("vertices").noconvert(),
          nb::arg("links").noconvert(), nb::arg("rates").noconvert(), nb::arg("smoothing").noconvert(),
          "One step of RMSProp with total variation on the touched rows, in place; clears their gradients.");
}
