// Search at the last pixels of the largest image with the most sources. Memory is reserved only: pages that are never
// touched cost nothing. Prints its findings for test_large_pictures.py.
#include <sys/mman.h>

#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>

#define PCB_ISA baseline
#define PCB_SPACE pcbench::mvs::PCB_ISA
#include "sweep.h"

using namespace pcbench::mvs;
using namespace pcbench::mvs::baseline;

namespace {

constexpr int kShift = 4;  // displacement in pixels from the image to each source
constexpr float kTrueDepth = 2.0f;
constexpr int kFrom = 4, kTo = 100;     // distance in pixels from the last row and column: the textured corner
constexpr int kColumn = 79, kRow = 40;  // the searched group, counted from the last column and row: of even colour

template <typename T>
T* reserved(int64_t count) {
    void* memory = mmap(nullptr, static_cast<size_t>(count) * sizeof(T), PROT_READ | PROT_WRITE,
                        MAP_PRIVATE | MAP_ANONYMOUS | MAP_NORESERVE, -1, 0);
    if (memory == MAP_FAILED) {
        std::puts("no address space");
        std::exit(0);
    }
    return static_cast<T*>(memory);
}

// The texture depends on the distance from the last pixel only, not on the size of the image.
int gray_at(int x, int y) {
    uint32_t value = static_cast<uint32_t>(x) * 0x9E3779B1u ^ static_cast<uint32_t>(y) * 0x85EBCA77u;
    value = (value ^ value >> 15) * 0x2C1B3C6Du;
    return static_cast<int>((value ^ value >> 12) & 255u);
}

}  // namespace

int main(int, char** arguments) {
    const int side = std::atoi(arguments[1]), sources = kMaxSources;
    const int64_t pixels = int64_t{side} * side;
    uint8_t* gray = reserved<uint8_t>(pixels);
    int32_t* quads = reserved<int32_t>(pixels);
    const auto number = [&](int from_last_x, int from_last_y) {
        return int64_t{side - 1 - from_last_y} * side + (side - 1 - from_last_x);
    };
    for (int y = 0; y < kTo; ++y)
        for (int x = 0; x < kTo; ++x) gray[number(x, y)] = static_cast<uint8_t>(gray_at(x, y));
    for (int y = 1; y < kTo; ++y)
        for (int x = 1; x < kTo; ++x) {  // the grey level at x in the image is at x + kShift in a source
            const auto byte = [&](int right, int down) {
                return static_cast<uint32_t>(gray_at(x + kShift - right, y - down)) ^ 0x80u;
            };
            quads[number(x, y)] =
                static_cast<int32_t>(byte(0, 0) | byte(1, 0) << 8 | byte(0, 1) << 16 | byte(1, 1) << 24);
        }

    Problem problem;
    problem.gray = gray;
    problem.width = problem.height = side;
    problem.fx = problem.fy = 1000.0f;
    problem.cx = problem.cy = static_cast<float>(side - kTo / 2);
    problem.source_count = sources;
    problem.nearest = 1.0f, problem.farthest = 4.0f;
    problem.pixels_per_depth = kShift * kTrueDepth;
    for (float& weight : problem.space_weights) weight = 1.0f;
    for (float& weight : problem.gray_weights) weight = 1.0f;
    for (int s = 0; s < sources; ++s) {
        Source& source = problem.sources[s];
        source.quads = quads;
        source.width = source.height = side;
        source.linear[0] = source.linear[4] = source.linear[8] = 1.0f;
        source.shift[0] = kShift * kTrueDepth;
    }

    State state;
    state.plane = reserved<float>(4 * pixels);
    state.cost = reserved<float>(pixels);
    state.view_costs = reserved<float>(sources * pixels);
    state.packed_columns = (side + 1) / 2 + kPackedLeft + kPackedRight;
    state.packed_costs = reserved<float>(state.packed_columns * (side + 2 * kPackedAbove));  // all costs are zero
    for (int y = kFrom; y < kTo; ++y)
        for (int x = 0; x < kTo; ++x) {
            float* plane = state.plane + 4 * number(x, y);
            plane[0] = kTrueDepth, plane[1] = plane[2] = 0.0f, plane[3] = -1.0f;
        }

    // First its own planes have lower costs than all neighbours and are kept.
    const int y = side - 1 - kRow, first = side - 1 - kColumn;
    int kept = 0;
    for (int l = 0; l < kLanes; ++l)
        for (int s = 0; s < sources; ++s)
            state.view_costs[number(kColumn - 2 * l, kRow) * sources + s] =
                -0.001f * static_cast<float>(s * kLanes + l + 1);
    Search<1>(problem, state, y, first).improve(0);
    for (int l = 0; l < kLanes; ++l)
        for (int s = 0; s < sources; ++s)
            kept += state.view_costs[number(kColumn - 2 * l, kRow) * sources + s] ==
                    -0.001f * static_cast<float>(s * kLanes + l + 1);

    // Then its own planes are wrong, and those of its neighbours are right, as patches of half of the texels see too.
    for (int l = 0; l < kLanes; ++l) {
        state.plane[4 * number(kColumn - 2 * l, kRow)] = 1.5f * kTrueDepth;
        for (int s = 0; s < sources; ++s) state.view_costs[number(kColumn - 2 * l, kRow) * sources + s] = kMaxCost;
    }
    Search<2>(problem, state, y, first).improve(0);
    int taken = 0;
    for (int l = 0; l < kLanes; ++l) {
        const int64_t at = number(kColumn - 2 * l, kRow);
        taken += std::fabs(state.plane[4 * at] - kTrueDepth) < 0.05f && state.cost[at] < 0.1f &&
                 state.view_costs[at * sources + sources - 1] < 0.1f;
    }
    std::printf("%d of %d costs kept, %d of %d planes taken\n", kept, kLanes * sources, taken, kLanes);
}
