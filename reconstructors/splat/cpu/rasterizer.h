// One rendering after another in the same memory: projection, sorting, blending, and the derivative of the last.
#pragma once
#include <vector>

#include "common/block.h"
#include "kernels.h"

namespace pcbench::splat {

const Kernels& kernels();

class Rasterizer {
public:
    // The model's arrays must live until the derivative has been taken.
    void forward(const Model& model, const Pinhole& pinhole, const float* background, const Pictures& pictures,
                 bool geometry);

    size_t drawn() const { return static_cast<size_t>(rows_.empty() ? 0 : rows_.back()); }
    size_t instances() const { return instances_.size(); }
    size_t bytes() const;  // of memory held
    void write_ids(int64_t* ids) const;

    void backward(const PictureGradients& by, const ModelGradients& out);

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
    std::vector<int64_t> rows_;    // drawn Gaussians before each group, and all of them
    std::vector<uint32_t> order_;  // slots by depth
    std::vector<uint64_t> keys_, sorted_;
    std::vector<Instance> instances_;
    std::vector<uint32_t> starts_;
    std::vector<float> moments_;
    struct Part {  // of the order of depth: its instances
        std::vector<uint32_t> slots, tiles, blocks;
        std::vector<uint32_t> next;  // by tile: how many, then where the next one goes
        size_t count = 0;
    };
    std::vector<Part> parts_;
};

// Of (1 - weight) mean |x - y| + weight (1 - mean similarity): the two means, and its derivative by x.
struct LossParts {
    double difference, similarity;
};
LossParts image_loss(const float* x, const float* y, int height, int width, float weight, float* gradient);

}  // namespace pcbench::splat
