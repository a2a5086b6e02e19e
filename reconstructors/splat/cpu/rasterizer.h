// One rendering after another with the same buffers: projection, sorting, blending, and the gradient of the last one.
#pragma once
#include <vector>

#include "common/block.h"
#include "kernels.h"

namespace pcbench::splat {

const Kernels& kernels();

class Rasterizer {
public:
    // The model's arrays must stay alive until `backward` has returned.
    void forward(const Model& model, const Pinhole& pinhole, const float* background, const Images& images);

    size_t drawn() const { return static_cast<size_t>(rows_.empty() ? 0 : rows_.back()); }
    size_t instances() const { return instances_.size(); }
    size_t bytes() const;  // size of the buffers
    void write_ids(int64_t* ids) const;

    void backward(const ImageGradients& grad, const ModelGradients& out);

private:
    void project();
    void sort_by_depth();
    void distribute();
    struct Part;
    void fill(Part& part, int64_t begin, int64_t end);

    Frame frame_{};
    int64_t groups_ = 0;
    // By slot.
    std::vector<float> splats_, depths_;
    std::vector<Box> boxes_;
    std::vector<uint32_t> ids_, first_, count_;
    std::vector<int> drawn_;
    std::vector<int64_t> rows_;    // number of drawn Gaussians before each group, and in total
    std::vector<uint32_t> order_;  // slots in depth order
    std::vector<uint64_t> keys_, sorted_;
    std::vector<Instance> instances_;
    std::vector<uint32_t> starts_;
    std::vector<float> moments_;
    struct Part {  // the instances of a range of the depth order
        std::vector<uint32_t> slots, tiles, blocks;
        std::vector<uint32_t> next;  // by tile: number of instances, then the position of the next one
        size_t count = 0;
    };
    std::vector<Part> parts_;
};

// The two means of (1 - weight) mean |x - y| + weight (1 - mean similarity); also computes its gradient with respect to
// x.
struct LossParts {
    double difference, similarity;
};
LossParts image_loss(const float* x, const float* y, int height, int width, float weight, float* gradient);

}  // namespace pcbench::splat
