// The loops that are compiled once for each instruction set, and the choice between them. None of them starts a thread.
#pragma once
#include "frame.h"

namespace pcbench::splat {

struct Kernels {
    const char* name;

    // Projects the Gaussians of a group into its slots; returns the number of drawn ones.
    int (*project)(const Frame&, int64_t group);

    // Writes the tiles that the splat of a slot touches, row by row, and their blocks; returns their number.
    int (*cover)(const Frame&, uint32_t slot, uint32_t* tiles, uint32_t* blocks);

    // Blends a tile; `splats` has room for all splats that touch it, `indices` for one more.
    void (*blend)(const Frame&, int tile, float* splats, uint32_t* indices);

    // The gradient of blend: the sums of each instance are written to `moments` at its emission.
    void (*blend_gradient)(const Frame&, const ImageGradients&, int tile, float* moments);

    // The gradient of the projection of a group. The emissions of a slot are first[slot] .. first[slot] + count[slot];
    // `row` is the group's first row in `out`.
    void (*project_gradient)(const Frame&, int64_t group, const float* moments, const uint32_t* first,
                             const uint32_t* count, int64_t row, const ModelGradients& out);

    // One row of the structural similarity of two images with `length` = 3 * width floats per row: three maps of its
    // gradient, and the sums over the row of |x - y| and of the similarity.
    void (*similarity)(const float* x, const float* y, int height, int length, int row, float* scratch,
                       float* grad_mean, float* grad_square, float* grad_product, double* sums);
    // One row of the gradient of (1 - weight) mean |x - y| + weight (1 - similarity) with respect to x, from those
    // maps.
    void (*loss_gradient)(const float* x, const float* y, int height, int length, int row, float weight, float* scratch,
                          const float* grad_mean, const float* grad_square, const float* grad_product, float* out);

    // One step of Adam on some rows; see adam.h.
    void (*adam)(float* parameters, float* first, float* second, const float* gradient, const int64_t* rows,
                 int64_t begin, int64_t end, int columns, const float* rates, float beta1, float beta2, float epsilon);
};

namespace baseline {
extern const Kernels kernels;
}
#ifdef PCB_X86
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

}  // namespace pcbench::splat
