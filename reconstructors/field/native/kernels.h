// The loops that are compiled once for each instruction set, and the choice between them. None of them starts a thread.
#pragma once
#include "field.h"

namespace pcbench::field {

struct Kernels {
    const char* name;

    // Follows a ray. Writes its samples with a positive density unless `samples` is null, and returns their number.
    int (*trace)(const Grid&, Ray&, Sample* samples, Pixel& pixel);

    // Replaces the channels of a ray's samples by the gradients of the squared color error; writes the gradient with
    // respect to the color behind the grid, and returns the error.
    float (*pull_back)(const Ray&, const Pixel&, const float* target, float step, Sample* samples, int count,
                       float* background);

    // Adds the gradients of a ray's samples to the vertices whose x belongs to this thread, so that every vertex sums
    // its samples in the order of the rays. `weights` keeps each vertex's largest blending weight.
    void (*scatter)(const Grid&, const Ray&, const Sample* samples, int count, int thread, int threads,
                    float* gradients, uint8_t* touched, float* weights);

    // Adds the gradient of the total variation to touched rows begin .. end.
    void (*smooth)(const Update&, int64_t begin, int64_t end);

    // One step of RMSProp on touched rows begin .. end; clears their gradients.
    void (*descend)(const Update&, int64_t begin, int64_t end);
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

}  // namespace pcbench::field
