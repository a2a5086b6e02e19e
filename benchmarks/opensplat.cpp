// Functions of OpenSplat's CPU rasterizer that tests/splat_contestants.py calls, if its source is available. None of
// that source is here: it is under the AGPL. The build is for local measurements only.
#include <torch/extension.h>

#include "rasterizer/gsplat-cpu/bindings.h"

namespace {

using torch::Tensor;
using Lists = std::vector<int32_t>;  // one for each pixel

py::capsule owned(Lists* lists) {
    return py::capsule(lists, [](void* p) { delete[] static_cast<Lists*>(p); });
}

Tensor none() { return torch::empty({0}); }

auto project(Tensor means, Tensor scales, Tensor quats, Tensor camera, Tensor clip, float fx, float fy, float cx,
             float cy, int height, int width) {
    return project_gaussians_forward_tensor_cpu(static_cast<int>(means.size(0)), means, scales, 1, quats, camera, clip,
                                                fx, fy, cx, cy, height, width, 0.01f);
}

Tensor harmonics(Tensor directions, Tensor sh) {
    return compute_sh_forward_tensor_cpu(static_cast<int>(sh.size(0)), 3, 3, directions, sh);
}

auto blend(int width, int height, Tensor xy, Tensor conics, Tensor colors, Tensor opacities, Tensor covariances,
           Tensor depths) {
    auto [image, through, lists] = rasterize_forward_tensor_cpu(width, height, xy, conics, colors, opacities,
                                                                torch::zeros({3}), covariances, depths);
    return std::make_tuple(image, through, owned(lists));
}

auto blend_backward(int width, int height, Tensor xy, Tensor conics, Tensor colors, Tensor opacities,
                    Tensor covariances, Tensor depths, Tensor through, py::capsule lists, Tensor by_image) {
    return rasterize_backward_tensor_cpu(height, width, xy, conics, colors, opacities, torch::zeros({3}), covariances,
                                         depths, through, lists.get_pointer<const Lists>(), by_image,
                                         torch::zeros_like(through), none(), none(), none(), none());
}

auto loss(Tensor image, Tensor target, float ssim_weight) {
    return fused_loss_forward_tensor_cpu(image, target, none(), ssim_weight, true, true);
}

Tensor loss_backward(Tensor image, Tensor target, Tensor partials, Tensor stats, Tensor by_loss, float ssim_weight) {
    return fused_loss_backward_tensor_cpu(image, target, none(), partials, stats, by_loss, ssim_weight, true);
}

}  // namespace

PYBIND11_MODULE(TORCH_EXTENSION_NAME, m) {
    m.def("project", project);
    m.def("harmonics", harmonics);
    m.def("blend", blend);
    m.def("blend_backward", blend_backward);
    m.def("loss", loss);
    m.def("loss_backward", loss_backward);
}
