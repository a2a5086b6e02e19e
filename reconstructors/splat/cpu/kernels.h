// The loops that exist once for each instruction set, and the choice between them. None of them starts a thread.
#pragma once
#include "frame.h"

namespace pcbench::splat {

struct Kernels {
    const char* name;

    // Projects the Gaussians of a group into its slots; returns how many are drawn.
    int (*project)(const Frame&, int64_t group);

    // Writes to `out` the tiles that the splat of a slot touches, with their blocks, row by row; returns how many.
    int (*cover)(const Frame&, uint32_t slot, uint32_t* tiles, uint32_t* blocks);

    // Blends a tile; `splats` has room for those that touch it, `listed` for one number more than there are.
    void (*blend)(const Frame&, int tile, float* splats, uint32_t* listed);

    // The derivative of that: the sums of each of its instances go to `moments` at its emission.
    void (*blend_gradient)(const Frame&, const PictureGradients&, int tile, float* moments);

    // The derivative of the projection of a group. first[slot] .. first[slot] + count[slot] are its emissions; `row` is
    // the group's first row in `out`.
    void (*project_gradient)(const Frame&, int64_t group, const float* moments, const uint32_t* first,
                             const uint32_t* count, int64_t row, const ModelGradients& out);

    // One row of the structural similarity of two pictures of `length` = 3 * width floats a row: three maps of its
    // derivative, and the sums over the row of |x - y| and of the similarity.
    void (*similarity)(const float* x, const float* y, int height, int length, int row, float* scratch, float* by_mean,
                       float* by_square, float* by_product, double* sums);
    // One row of the derivative of (1 - weight) mean |x - y| + weight (1 - similarity) by x, from those maps.
    void (*loss_gradient)(const float* x, const float* y, int height, int length, int row, float weight, float* scratch,
                          const float* by_mean, const float* by_square, const float* by_product, float* out);

    // One step of Adam on some rows: see adam.h.
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
