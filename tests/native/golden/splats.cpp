// The rasterizer: rendered Gaussians, the gradient of a loss with respect to them, and one step of Adam.
#include <cmath>

#include "golden.h"
#include "rasterizer.h"

void golden::splats() {
    using namespace pcbench::splat;
    constexpr int kCount = 400, kBands = 16, kWidth = 90, kHeight = 70;
    constexpr size_t kPixels = static_cast<size_t>(kWidth) * kHeight;
    Random random(5);
    std::vector<float> means, quaternions, scales, opacities, harmonics;
    for (int i = 0; i < kCount; ++i) {
        float q[4], square = 0;
        for (float& entry : q) entry = random.uniform_float(-1, 2) + 0x1p-13f, square += entry * entry;
        for (const float entry : q) quaternions.push_back(entry / std::sqrt(square));
        for (int axis = 0; axis < 3; ++axis) {
            means.push_back(random.uniform_float(-2, 4));
            scales.push_back(0.03125f + random.uniform_float(0, 1) / 8);
        }
        opacities.push_back(0.0625f + random.uniform_float(0, 1) * 0.875f);
        for (int k = 0; k < 3 * kBands; ++k)
            harmonics.push_back(random.uniform_float(-1, 2) / static_cast<float>(1 + k / 3));
    }
    const Model model = {kCount,           means.data(), quaternions.data(), scales.data(), opacities.data(),
                         harmonics.data(), kBands};
    Pinhole pinhole = {};
    pinhole.rotation[0] = pinhole.rotation[4] = pinhole.rotation[8] = 1;
    pinhole.position[2] = -5;
    pinhole.fx = pinhole.fy = 80, pinhole.cx = kWidth / 2.0f, pinhole.cy = kHeight / 2.0f;
    pinhole.left = pinhole.top = -0.75f, pinhole.right = pinhole.bottom = 0.75f;
    pinhole.min_alpha = 0x1p-8f, pinhole.min_level = -8, pinhole.min_transmittance = 0x1p-13f;
    pinhole.nearest = 0.0625f, pinhole.width = kWidth, pinhole.height = kHeight;
    const float background[3] = {0.25f, 0.5f, 0.75f};
    std::vector<float> color(3 * kPixels), transmittance(kPixels), depth(kPixels), normal(3 * kPixels), median(kPixels);
    Rasterizer rasterizer;
    rasterizer.forward(model, pinhole, background,
                       {color.data(), transmittance.data(), depth.data(), normal.data(), median.data()});
    Hash("splat_forward").add(color).add(transmittance).add(depth).add(normal).add(median);

    std::vector<float> color_gradient, transmittance_gradient, depth_gradient, normal_gradient;
    for (size_t pixel = 0; pixel < kPixels; ++pixel) {
        for (int channel = 0; channel < 3; ++channel) {
            color_gradient.push_back(random.uniform_float(-1, 2));
            normal_gradient.push_back(random.uniform_float(-1, 2));
        }
        transmittance_gradient.push_back(random.uniform_float(-1, 2));
        depth_gradient.push_back(random.uniform_float(-1, 2));
    }
    const size_t rows = rasterizer.drawn();
    std::vector<int64_t> ids(rows);
    rasterizer.write_ids(ids.data());
    std::vector<float> gradients[6];
    const size_t widths[6] = {3, 4, 3, 1, 3 * kBands, 2};
    for (int k = 0; k < 6; ++k) gradients[k].resize(widths[k] * rows);
    rasterizer.backward(
        {color_gradient.data(), transmittance_gradient.data(), depth_gradient.data(), normal_gradient.data()},
        {gradients[0].data(), gradients[1].data(), gradients[2].data(), gradients[3].data(), gradients[4].data(),
         gradients[5].data()});
    {
        Hash hash("splat_backward");
        hash.add(ids);
        for (const std::vector<float>& gradient : gradients) hash.add(gradient);
    }
    std::printf("# Gaussians drawn: %zu of %d\n", rows, kCount);

    std::vector<float> gradient(3 * kPixels);
    const LossParts parts = image_loss(color.data(), normal_gradient.data(), kHeight, kWidth, 0.25f, gradient.data());
    Hash("image_loss").add(gradient).add(std::vector<double>{parts.difference, parts.similarity});

    std::vector<float> first_moments(means.size()), second_moments(means.size());
    const float rates[3] = {0.0625f, 0.125f, 0.25f};
    kernels().adam(means.data(), first_moments.data(), second_moments.data(), gradients[0].data(), ids.data(), 0,
                   static_cast<int64_t>(rows), 3, rates, 0.875f, 0.96875f, 0x1p-20f);
    Hash("adam").add(means).add(first_moments).add(second_moments);
}
