// PatchMatch depth map: three sweeps over a small image of a plane, with two source images.
#include <algorithm>

#include "common/choose_kernels.h"
#include "golden.h"
#include "kernels.h"

namespace {

using namespace pcbench::mvs;

constexpr int kWidth = 96, kHeight = 64;
constexpr float kFocal = 100, kBaseline = 0.5f, kDepth = 10;  // five pixels of parallax

bool no_interrupt() { return false; }

const Kernels& dispatched_kernels() {
    return pcbench::choose_kernels<Kernels>({
#ifdef PCB_X86
        &avx512::kernels, &avx2::kernels,
#endif
        &baseline::kernels});
}

// Integer texture: noise with a scale of a few pixels.
uint8_t texture(int x, int y) {
    uint32_t total = 0;
    for (int scale = 1; scale <= 4; scale *= 2) {
        uint32_t cell =
            static_cast<uint32_t>((x + 1000) / scale) * 73856093u ^ static_cast<uint32_t>(y / scale) * 19349663u;
        cell = (cell ^ cell >> 13) * 2654435761u;
        total += cell >> 25;  // 0 .. 127
    }
    return static_cast<uint8_t>(std::min<uint32_t>(total * 2 / 3, 255));
}

std::vector<uint8_t> textured_image(int shift) {
    std::vector<uint8_t> image;
    for (int y = 0; y < kHeight; ++y)
        for (int x = 0; x < kWidth; ++x) image.push_back(texture(x + shift, y));
    return image;
}

std::vector<int32_t> pack_quads(const std::vector<uint8_t>& image) {
    std::vector<int32_t> packed;
    for (int y = 0; y < kHeight; ++y)
        for (int x = 0; x < kWidth; ++x) {
            const int right = std::min(x + 1, kWidth - 1), below = std::min(y + 1, kHeight - 1);
            const uint32_t quad = image[y * kWidth + x] | image[y * kWidth + right] << 8 |
                                  image[below * kWidth + x] << 16 |
                                  static_cast<uint32_t>(image[below * kWidth + right]) << 24;
            packed.push_back(static_cast<int32_t>(quad ^ 0x80808080u));
        }
    return packed;
}

}  // namespace

void golden::patchmatch() {
    const std::vector<uint8_t> reference = textured_image(0);
    const std::vector<int32_t> left = pack_quads(textured_image(5)), right = pack_quads(textured_image(-5));
    const std::vector<float> depth(kWidth * kHeight, kDepth);
    Problem problem;
    problem.gray = reference.data();
    problem.width = kWidth, problem.height = kHeight;
    problem.fx = problem.fy = kFocal, problem.cx = kWidth / 2.0f, problem.cy = kHeight / 2.0f;
    problem.source_count = 2;
    for (int s = 0; s < 2; ++s) {
        Source& source = problem.sources[s];
        source.quads = s == 0 ? left.data() : right.data();
        source.width = kWidth, source.height = kHeight;
        for (int i = 0; i < 9; i += 4) source.linear[i] = source.back_linear[i] = 1;
        source.shift[0] = (s == 0 ? -1 : 1) * kFocal * kBaseline, source.back_shift[0] = -source.shift[0];
        source.depth = s == 0 ? nullptr : depth.data();
    }
    problem.nearest = 5, problem.farthest = 20, problem.pixels_per_depth = kFocal * kBaseline, problem.seed = 7;
    for (int k = 0; k < 25; ++k)
        problem.space_weights[k] = 1.0f / static_cast<float>(1 + (k % 5 - 2) * (k % 5 - 2) + (k / 5 - 2) * (k / 5 - 2));
    for (int step = 0; step < 256; ++step) problem.gray_weights[step] = 16.0f / static_cast<float>(16 + step);

    std::vector<float> planes(4 * kWidth * kHeight), cost(kWidth * kHeight), view_costs(2 * kWidth * kHeight);
    const int64_t columns = (kWidth + 1) / 2 + kPackedLeft + kPackedRight;
    std::vector<float> packed_costs(static_cast<size_t>(columns) * (kHeight + 2 * kPackedAbove));
    State state{planes.data(), cost.data(), view_costs.data(), packed_costs.data(), columns};
    pcbench::Interrupt interrupt(no_interrupt);
    dispatched_kernels().initialize(problem, state, interrupt);
    Hash("patchmatch_begin").add(planes).add(cost).add(view_costs);
    for (int number = 0; number < 3; ++number) dispatched_kernels().sweep(problem, state, number, interrupt);
    Hash("patchmatch_sweeps").add(planes).add(cost).add(view_costs);
    int accurate_pixels = 0;
    for (int pixel = 0; pixel < kWidth * kHeight; ++pixel)
        accurate_pixels += planes[4 * pixel] > 0.98f * kDepth && planes[4 * pixel] < 1.02f * kDepth;
    std::printf("# pixels within 2 %% of the plane: %d of %d\n", accurate_pixels, kWidth * kHeight);
}
