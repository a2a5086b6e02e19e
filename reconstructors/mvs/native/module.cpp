// Python bindings of the search for depth maps.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <cmath>
#include <optional>
#include <vector>

#include "common/arrays.h"
#include "common/choose_kernels.h"
#include "common/forked.h"
#include "common/interruptible.h"
#include "confirm.h"
#include "kernels.h"

namespace {

using pcbench::mvs::Kernels;
using pcbench::mvs::Problem;
using pcbench::mvs::Source;
using pcbench::mvs::State;
using Gray = In<uint8_t, nb::ndim<2>>;
using Map = In<float, nb::ndim<2>>;
using Matrix = In<float, nb::shape<3, 4>>;

const Kernels& kernels() {
    static const Kernels& chosen = pcbench::choose_kernels<Kernels>({
#ifdef PCB_X86
        &pcbench::mvs::avx512::kernels, &pcbench::mvs::avx2::kernels,
#endif
        &pcbench::mvs::baseline::kernels});
    return chosen;
}

std::vector<int32_t> quads(Gray image) {
    const size_t height = image.shape(0), width = image.shape(1);
    std::vector<int32_t> out(width * height);
    const uint8_t* from = image.data();
    for (size_t y = 0; y < height; ++y) {
        const uint8_t *line = from + y * width, *below = from + std::min(y + 1, height - 1) * width;
        for (size_t x = 0; x < width; ++x) {
            const size_t right = std::min(x + 1, width - 1);
            const uint32_t quad = static_cast<uint32_t>(line[x]) | static_cast<uint32_t>(line[right]) << 8 |
                                  static_cast<uint32_t>(below[x]) << 16 | static_cast<uint32_t>(below[right]) << 24;
            out[y * width + x] = static_cast<int32_t>(quad ^ 0x80808080u);  // minus 128 each, as signed bytes
        }
    }
    return out;
}

void split(Matrix motion, float* linear, float* shift) {
    for (int r = 0; r < 3; ++r) {
        std::copy_n(motion.data() + 4 * r, 3, linear + 3 * r);
        shift[r] = motion.data()[4 * r + 3];
    }
}

// One photograph, its sources, and the search for its depth map.
class Matcher {
public:
    Matcher(Gray gray, In<float, nb::shape<4>> pinhole, std::optional<Gray> valid, double nearest, double farthest,
            double pixels_per_depth, double min_variance, bool half_patches, uint32_t seed)
        : gray_(gray), valid_(valid) {
        problem_.gray = gray_.data();
        problem_.height = static_cast<int>(gray_.shape(0));
        problem_.width = static_cast<int>(gray_.shape(1));
        check_size(gray);
        if (valid_) {
            check(valid_->shape(0) == gray_.shape(0) && valid_->shape(1) == gray_.shape(1),
                  "expected a mask of the image's size");
            problem_.valid = valid_->data();
        }
        check(nearest > 0 && farthest > nearest, "expected 0 < nearest < farthest");
        check(pixels_per_depth > 0, "expected pixels_per_depth > 0");
        problem_.fx = pinhole.data()[0], problem_.fy = pinhole.data()[1];
        problem_.cx = pinhole.data()[2], problem_.cy = pinhole.data()[3];
        problem_.nearest = static_cast<float>(nearest), problem_.farthest = static_cast<float>(farthest);
        problem_.pixels_per_depth = static_cast<float>(pixels_per_depth);
        check(min_variance > 0, "expected min_variance > 0");
        problem_.min_variance = static_cast<float>(min_variance);
        problem_.half_patches = half_patches;
        problem_.seed = seed;
        for (int k = 0; k < 25; ++k) {
            const double i = k % 5 - 2, j = k / 5 - 2;
            problem_.space_weights[k] =
                static_cast<float>(std::exp(-4.0 * (i * i + j * j) / (2 * kSpaceSigma * kSpaceSigma)));
        }
        for (int step = 0; step < 256; ++step)
            problem_.gray_weights[step] = static_cast<float>(std::exp(-step * step / (2 * kGraySigma * kGraySigma)));
    }

    void add_source(Gray gray, Matrix motion, std::optional<Map> depth, Matrix back, std::optional<Map> visible) {
        check(problem_.source_count < pcbench::mvs::kMaxSources, "expected at most 16 sources");
        Source& source = problem_.sources[problem_.source_count++];
        source.height = static_cast<int>(gray.shape(0));
        source.width = static_cast<int>(gray.shape(1));
        check_size(gray);
        quads_.push_back(quads(gray));
        source.quads = quads_.back().data();
        split(motion, source.linear, source.shift);
        split(back, source.back_linear, source.back_shift);
        if (depth) {
            check(depth->shape(0) == gray.shape(0) && depth->shape(1) == gray.shape(1),
                  "expected a depth map of the source's size");
            depths_.push_back(*depth);
            source.depth = depths_.back().data();
        }
        if (visible) {
            check(visible->shape(0) == gray.shape(0) && visible->shape(1) == gray.shape(1),
                  "expected a mask of the source's size");
            visible_.push_back(*visible);
            source.visible = visible_.back().data();
        }
    }

    void run(Out<float, nb::shape<-1, -1, 4>> planes, Out<float, nb::ndim<2>> cost, Out<float, nb::ndim<3>> view_costs,
             int sweeps, int first) {
        const auto sized = [&](const auto& array) {
            return array.shape(0) == gray_.shape(0) && array.shape(1) == gray_.shape(1);
        };
        check(sized(planes) && sized(cost) && sized(view_costs), "expected maps of the image's size");
        check(view_costs.shape(2) == static_cast<size_t>(problem_.source_count), "expected one cost per source");
        check(problem_.source_count > 0, "expected at least one source");
        const int64_t columns = (problem_.width + 1) / 2 + pcbench::mvs::kPackedLeft + pcbench::mvs::kPackedRight;
        std::vector<float> packed_costs(columns * (problem_.height + 2 * pcbench::mvs::kPackedAbove));
        State state{planes.data(), cost.data(), view_costs.data(), packed_costs.data(), columns};
        pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
            if (!kernels().initialize(problem_, state, interrupt)) return;
            for (int i = 0; i < sweeps; ++i)
                if (!kernels().sweep(problem_, state, first + i, interrupt)) return;
        });
    }

private:
    static void check_size(Gray gray) {
        const auto fits = [](size_t side) { return side > 0 && side <= pcbench::mvs::kMaxSide; };
        check(fits(gray.shape(0)) && fits(gray.shape(1)), "expected an image of 1 to 32,000 pixels along each side");
    }

    static constexpr double kSpaceSigma = 4.0, kGraySigma = 25.0;

    Problem problem_;
    Gray gray_;
    std::optional<Gray> valid_;
    std::vector<std::vector<int32_t>> quads_;
    std::vector<Map> depths_, visible_;
};

using Motion = In<double, nb::shape<3, 4>>;
using Normals = In<float, nb::shape<-1, -1, 3>>;

pcbench::mvs::ConfirmMap checked_map(Map depth, Normals normal, Map confidence) {
    const auto sized = [&](const auto& array) {
        return array.shape(0) == depth.shape(0) && array.shape(1) == depth.shape(1);
    };
    check(sized(normal) && sized(confidence), "expected depths, normals and confidences of one size");
    return {depth.data(), normal.data(), confidence.data(), static_cast<int64_t>(depth.shape(0)),
            static_cast<int64_t>(depth.shape(1))};
}

void confirm(Map depth, Normals normal, Map confidence, Indices rows, Indices columns, Map other_depth,
             Normals other_normal, Map other_confidence, In<double, nb::shape<4>> other_pinhole, Motion to_other,
             Motion back, In<double, nb::shape<3, 3>> turn, double min_confidence, double max_pixels, double max_depth,
             double min_cosine, Out<double, nb::shape<-1>> depths, Out<bool, nb::shape<-1>> sees_through) {
    const pcbench::mvs::Confirmations confirmations{checked_map(depth, normal, confidence),
                                                    checked_map(other_depth, other_normal, other_confidence),
                                                    {to_other.data()},
                                                    {back.data()},
                                                    other_pinhole.data(),
                                                    turn.data(),
                                                    {min_confidence, max_pixels, max_depth, min_cosine}};
    const auto count = static_cast<int64_t>(rows.shape(0));
    check(
        columns.shape(0) == rows.shape(0) && depths.shape(0) == rows.shape(0) && sees_through.shape(0) == rows.shape(0),
        "expected as many columns and results as rows");
    for (int64_t i = 0; i < count; ++i) {
        const int64_t row = rows.data()[i], column = columns.data()[i];
        check(row >= 0 && row < confirmations.map.height && column >= 0 && column < confirmations.map.width,
              "expected pixels inside the map");
    }
    pcbench::interruptible([&](pcbench::Interrupt& interrupt) {
        confirmations.run(rows.data(), columns.data(), count, depths.data(), sees_through.data(), interrupt);
    });
}

}  // namespace

NB_MODULE(_patchmatch, m) {
    m.doc() = "Compiled PatchMatch stereo; call it through reconstructors.mvs.patchmatch.";
    pcbench::one_thread_when_forked();

    m.def("isa", [] { return kernels().name; }, "The instruction set in use: baseline, avx2 or avx512.");

    nb::class_<Matcher>(m, "Matcher", "Search for one photograph's depth map.")
        .def(nb::init<Gray, In<float, nb::shape<4>>, std::optional<Gray>, double, double, double, double, bool,
                      uint32_t>(),
             nb::arg("gray").noconvert(), nb::arg("pinhole").noconvert(), nb::arg("valid").noconvert().none(),
             nb::arg("nearest"), nb::arg("farthest"), nb::arg("pixels_per_depth"), nb::arg("min_variance"),
             nb::arg("half_patches"), nb::arg("seed"))
        .def("add_source", &Matcher::add_source, nb::arg("gray").noconvert(), nb::arg("motion").noconvert(),
             nb::arg("depth").noconvert().none(), nb::arg("back").noconvert(), nb::arg("visible").noconvert().none(),
             "Add a source image.\n\n"
             "Args:\n"
             "    gray: grey levels (H, W) of the source.\n"
             "    motion: (3, 4), from homogeneous pixels times depth of the reference to those of the source.\n"
             "    depth: depth map of the source, None without one; agreement with it is part of the cost.\n"
             "    back: (3, 4), from homogeneous pixels times depth of the source to those of the reference.\n"
             "    visible: (H, W), 0 where a mask hides the source; None without a mask.")
        .def("run", &Matcher::run, nb::arg("planes").noconvert(), nb::arg("cost").noconvert(),
             nb::arg("view_costs").noconvert(), nb::arg("sweeps"), nb::arg("first") = 0,
             "Improve planes in place.\n\n"
             "Args:\n"
             "    planes: (H, W, 4), depth and normal of each pixel. A plane whose depth is outside the range is"
             " replaced by a random one.\n"
             "    cost: (H, W), written.\n"
             "    view_costs: (H, W, sources), written.\n"
             "    sweeps: number of sweeps.\n"
             "    first: index of the first sweep; perturbations shrink with it.");

    m.def("confirm", &confirm, nb::arg("depth").noconvert(), nb::arg("normal").noconvert(),
          nb::arg("confidence").noconvert(), nb::arg("rows").noconvert(), nb::arg("columns").noconvert(),
          nb::arg("other_depth").noconvert(), nb::arg("other_normal").noconvert(),
          nb::arg("other_confidence").noconvert(), nb::arg("other_pinhole").noconvert(),
          nb::arg("to_other").noconvert(), nb::arg("back").noconvert(), nb::arg("turn").noconvert(),
          nb::arg("min_confidence"), nb::arg("max_pixels"), nb::arg("max_depth"), nb::arg("min_cosine"),
          nb::arg("depths").noconvert(), nb::arg("sees_through").noconvert(),
          "Confirm depths of a map by another map; see reconstructors.mvs.filter.confirm.");
}
