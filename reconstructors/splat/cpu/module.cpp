// Python bindings of the Gaussian rasterizer on the CPU.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <tuple>
#include <vector>

#include "common/arrays.h"
#include "common/forked.h"
#include "rasterizer.h"

namespace {

using namespace pcbench::splat;
using Rows2 = Out<float, nb::shape<-1, 2>>;
using Rows3 = Out<float, nb::shape<-1, 3>>;
using Rows4 = Out<float, nb::shape<-1, 4>>;
using Values = Out<float, nb::shape<-1>>;
using Image = Out<float, nb::shape<-1, -1>>;
using ColorImage = Out<float, nb::shape<-1, -1, 3>>;
using InImage = In<float, nb::shape<-1, -1>>;
using InColorImage = In<float, nb::shape<-1, -1, 3>>;

constexpr int kMaxSide = 1 << 19;  // pixels: tiles are counted in 16 bits

template <typename Array>
auto* data(std::optional<Array>& array) {
    return array ? array->data() : nullptr;
}

class PyRasterizer {
public:
    void forward(In<float, nb::shape<-1, 3>> means, In<float, nb::shape<-1, 4>> quaternions,
                 In<float, nb::shape<-1, 3>> scales, In<float, nb::shape<-1>> opacities,
                 In<float, nb::shape<-1, -1, 3>> harmonics, In<float, nb::shape<3, 3>> rotation,
                 In<float, nb::shape<3>> position, In<float, nb::shape<4>> pinhole, In<float, nb::shape<4>> limits,
                 In<float, nb::shape<4>> cutoffs, In<float, nb::shape<3>> background, ColorImage color,
                 Image transmittance, std::optional<Image> depth, std::optional<ColorImage> normal,
                 std::optional<Image> median_depth) {
        const size_t count = means.shape(0), bands = harmonics.shape(1);
        check(quaternions.shape(0) == count && scales.shape(0) == count && opacities.shape(0) == count &&
                  harmonics.shape(0) == count,
              "expected as many quaternions, scales, opacities and harmonics as means");
        check(bands == 1 || bands == 4 || bands == 9 || bands == 16, "expected 1, 4, 9 or 16 spherical harmonics");
        check(count < UINT32_MAX - kGroup, "expected fewer than 2^32 Gaussians");
        check(cutoffs.data()[0] > 0, "expected a depth of the nearest Gaussians > 0");
        Pinhole at;
        std::copy_n(rotation.data(), 9, at.rotation);
        std::copy_n(position.data(), 3, at.position);
        at.fx = pinhole.data()[0], at.fy = pinhole.data()[1], at.cx = pinhole.data()[2], at.cy = pinhole.data()[3];
        at.left = limits.data()[0], at.right = limits.data()[1];
        at.top = limits.data()[2], at.bottom = limits.data()[3];
        at.nearest = cutoffs.data()[0], at.min_alpha = cutoffs.data()[1], at.min_level = cutoffs.data()[2];
        at.min_transmittance = cutoffs.data()[3];
        height_ = color.shape(0), width_ = color.shape(1);
        check(height_ >= 1 && width_ >= 1 && height_ <= kMaxSide && width_ <= kMaxSide,
              "expected an image of 1 to 2^19 pixels a side");
        at.height = static_cast<int>(height_), at.width = static_cast<int>(width_);
        check(normal.has_value() == median_depth.has_value() && (depth || !normal),
              "expected normal and median_depth together, and only with depth");
        check(has_size(transmittance) && (!depth || has_size(*depth)) &&
                  (!normal || (has_size(*normal) && has_size(*median_depth))),
              "expected images of one size");
        // The backward pass reads these arrays again.
        has_forward_ = false;
        inputs_ = {means, quaternions, scales, opacities, harmonics, color, transmittance, depth, normal};
        const Model model = {static_cast<int64_t>(count),
                             means.data(),
                             quaternions.data(),
                             scales.data(),
                             opacities.data(),
                             harmonics.data(),
                             static_cast<int>(bands)};
        const Images images = {color.data(), transmittance.data(), data(depth), data(normal), data(median_depth)};
        has_depth_ = depth.has_value(), has_normal_ = normal.has_value(), bands_ = bands;
        has_forward_ = false;
        {
            nb::gil_scoped_release release;
            rasterizer_.forward(model, at, background.data(), images);
        }
        has_forward_ = true;
    }

    void backward(InColorImage color, std::optional<InImage> transmittance, std::optional<InImage> depth,
                  std::optional<InColorImage> normal, Out<int64_t, nb::shape<-1>> ids, Rows3 means, Rows4 quaternions,
                  Rows3 scales, Values opacities, Out<float, nb::shape<-1, -1, 3>> harmonics, Rows2 screen) {
        check(has_forward_, "expected a forward pass before backward");
        check((has_depth_ || !depth) && (has_normal_ || !normal), "expected gradients of images that were rendered");
        check(has_size(color) && (!transmittance || has_size(*transmittance)) && (!depth || has_size(*depth)) &&
                  (!normal || has_size(*normal)),
              "expected gradients of the images' size");
        const size_t rows = rasterizer_.drawn();
        check(ids.shape(0) == rows && means.shape(0) == rows && quaternions.shape(0) == rows &&
                  scales.shape(0) == rows && opacities.shape(0) == rows && harmonics.shape(0) == rows &&
                  harmonics.shape(1) == bands_ && screen.shape(0) == rows,
              "expected one row for each drawn Gaussian");
        const ImageGradients grad = {color.data(), data(transmittance), data(depth), data(normal)};
        const ModelGradients out = {means.data(),     quaternions.data(), scales.data(),
                                    opacities.data(), harmonics.data(),   screen.data()};
        nb::gil_scoped_release release;
        rasterizer_.write_ids(ids.data());
        rasterizer_.backward(grad, out);
    }

    size_t drawn() const { return rasterizer_.drawn(); }
    size_t instances() const { return rasterizer_.instances(); }
    size_t bytes() const { return rasterizer_.bytes(); }

private:
    template <typename Array>
    bool has_size(const Array& array) const {
        return array.shape(0) == height_ && array.shape(1) == width_;
    }

    Rasterizer rasterizer_;
    size_t height_ = 0, width_ = 0, bands_ = 0;
    bool has_depth_ = false, has_normal_ = false, has_forward_ = false;
    struct Inputs {
        std::optional<In<float, nb::shape<-1, 3>>> means;
        std::optional<In<float, nb::shape<-1, 4>>> quaternions;
        std::optional<In<float, nb::shape<-1, 3>>> scales;
        std::optional<In<float, nb::shape<-1>>> opacities;
        std::optional<In<float, nb::shape<-1, -1, 3>>> harmonics;
        std::optional<ColorImage> color;
        std::optional<Image> transmittance, depth;
        std::optional<ColorImage> normal;
    } inputs_;
};

std::tuple<double, double> loss_of(InColorImage image, InColorImage target, float ssim_weight, ColorImage gradient) {
    const size_t height = image.shape(0), width = image.shape(1);
    check(target.shape(0) == height && target.shape(1) == width && gradient.shape(0) == height &&
              gradient.shape(1) == width,
          "expected an image, a target and a gradient of one size");
    check(height >= 1 && width >= 1 && height <= kMaxSide && width <= kMaxSide,
          "expected an image of 1 to 2^19 pixels a side");
    nb::gil_scoped_release release;
    const LossParts parts = image_loss(image.data(), target.data(), static_cast<int>(height), static_cast<int>(width),
                                       ssim_weight, gradient.data());
    return {parts.difference, parts.similarity};
}

void adam_step(Out<float, nb::ndim<2>> parameters, Out<float, nb::ndim<2>> first, Out<float, nb::ndim<2>> second,
               In<float, nb::ndim<2>> gradient, In<int64_t, nb::shape<-1>> rows, In<float, nb::shape<-1>> rates,
               int64_t step, double beta1, double beta2, double epsilon) {
    const size_t columns = parameters.shape(1);
    const auto same = [&](const auto& array) { return array.shape(1) == columns; };
    check(same(first) && same(second) && same(gradient) && first.shape(0) == parameters.shape(0) &&
              second.shape(0) == parameters.shape(0) && gradient.shape(0) == rows.shape(0),
          "expected moments of the parameters' shape and a gradient with one row for each of rows");
    check(rates.shape(0) == columns, "expected one learning rate for each column");
    check(step >= 1, "expected step >= 1");
    const int64_t count = static_cast<int64_t>(rows.shape(0)), limit = static_cast<int64_t>(parameters.shape(0));
    int64_t previous = -1;
    for (int64_t i = 0; i < count; ++i) {
        check(rows.data()[i] > previous && rows.data()[i] < limit, "expected ascending rows of the parameters");
        previous = rows.data()[i];
    }
    const double corrected = std::sqrt(1 - std::pow(beta2, static_cast<double>(step)));
    const double correction = corrected / (1 - std::pow(beta1, static_cast<double>(step)));
    std::vector<float> scaled(columns);
    for (size_t k = 0; k < columns; ++k) scaled[k] = static_cast<float>(rates.data()[k] * correction);
    constexpr int64_t kRows = 1024;
    kernels();
    nb::gil_scoped_release release;
#pragma omp parallel for schedule(static)
    for (int64_t begin = 0; begin < count; begin += kRows)
        kernels().adam(parameters.data(), first.data(), second.data(), gradient.data(), rows.data(), begin,
                       std::min(begin + kRows, count), static_cast<int>(columns), scaled.data(),
                       static_cast<float>(beta1), static_cast<float>(beta2), static_cast<float>(epsilon * corrected));
}

}  // namespace

NB_MODULE(_rasterizer, m) {
    m.doc() = "The compiled Gaussian rasterizer; call it through reconstructors.splat.";
    pcbench::one_thread_when_forked();
    // When Python exits, torch keeps the graphs that are still alive, and so their rasterizers: not a leak of this
    // module.
    nb::set_leak_warnings(false);

    m.def("isa", [] { return kernels().name; }, "The instruction set in use: baseline, avx2 or avx512.");

    nb::class_<PyRasterizer>(m, "Rasterizer", "Renders Gaussians and computes gradients; the buffers are reused.")
        .def(nb::init<>())
        .def("forward", &PyRasterizer::forward, nb::arg("means").noconvert(), nb::arg("quaternions").noconvert(),
             nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(), nb::arg("harmonics").noconvert(),
             nb::arg("rotation").noconvert(), nb::arg("position").noconvert(), nb::arg("pinhole").noconvert(),
             nb::arg("limits").noconvert(), nb::arg("cutoffs").noconvert(), nb::arg("background").noconvert(),
             nb::arg("color").noconvert(), nb::arg("transmittance").noconvert(), nb::arg("depth").noconvert().none(),
             nb::arg("normal").noconvert().none(), nb::arg("median_depth").noconvert().none(),
             "Renders the images. pinhole: fx, fy, cx, cy; limits: left, right, top, bottom of x / z and y / z; "
             "cutoffs: nearest "
             "depth, minimum alpha, its logarithm to base 2, minimum transmittance.")
        .def("backward", &PyRasterizer::backward, nb::arg("grad_color").noconvert(),
             nb::arg("grad_transmittance").noconvert().none(), nb::arg("grad_depth").noconvert().none(),
             nb::arg("grad_normal").noconvert().none(), nb::arg("ids").noconvert(), nb::arg("means").noconvert(),
             nb::arg("quaternions").noconvert(), nb::arg("scales").noconvert(), nb::arg("opacities").noconvert(),
             nb::arg("harmonics").noconvert(), nb::arg("screen").noconvert(),
             "Computes the gradients with respect to the Gaussians of the last forward pass, one row for each.")
        .def_prop_ro("drawn", &PyRasterizer::drawn, "Number of Gaussians that the last forward pass drew.")
        .def_prop_ro("instances", &PyRasterizer::instances, "Number of pairs of a Gaussian and a tile that it touches.")
        .def_prop_ro("bytes", &PyRasterizer::bytes, "Size of the buffers in bytes.");

    m.def("image_loss", &loss_of, nb::arg("image").noconvert(), nb::arg("target").noconvert(), nb::arg("ssim_weight"),
          nb::arg("gradient").noconvert(),
          "Mean absolute difference and mean SSIM; writes the gradient of (1 - w) L1 + w (1 - SSIM).");

    m.def("adam", &adam_step, nb::arg("parameters").noconvert(), nb::arg("first").noconvert(),
          nb::arg("second").noconvert(), nb::arg("gradient").noconvert(), nb::arg("rows").noconvert(),
          nb::arg("rates").noconvert(), nb::arg("step"), nb::arg("beta1"), nb::arg("beta2"), nb::arg("epsilon"),
          "One step of Adam on some rows, in place.");
}
