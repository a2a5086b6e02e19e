#include "rasterizer.h"

#include <omp.h>

#include <algorithm>
#include <cstring>
#include <stdexcept>
#include <utility>

#include "common/block.h"
#include "common/choose_kernels.h"
#include "common/first_error.h"

namespace pcbench::splat {

const Kernels& kernels() {
    static const Kernels& chosen = choose_kernels<Kernels>({
#ifdef PCB_X86
        &avx512::kernels, &avx2::kernels,
#endif
        &baseline::kernels});
    return chosen;
}

void Rasterizer::forward(const Model& model, const Pinhole& pinhole, const float* background, const Images& images) {
    kernels();  // throws before threads start if the environment names kernels that do not run here
    frame_.model = model;
    frame_.pinhole = pinhole;
    std::copy_n(background, 3, frame_.background);
    frame_.tiles_across = (pinhole.width + kTile - 1) / kTile;
    frame_.tiles_down = (pinhole.height + kTile - 1) / kTile;
    frame_.geometry = images.depth == nullptr ? kNoGeometry : images.normal == nullptr ? kDepth : kNormals;
    frame_.images = images;
    project();
    sort_by_depth();
    distribute();
    const int tiles = frame_.tiles_across * frame_.tiles_down;
    // Memory for each thread, allocated before any of them starts: a tile's splats, and a list of their indices.
    size_t max_splats = 1;
    for (int tile = 0; tile < tiles; ++tile)
        max_splats = std::max<size_t>(max_splats, starts_[tile + 1] - starts_[tile]);
    const size_t threads = static_cast<size_t>(omp_get_max_threads());
    const Block<float> splats = allocate<float>(threads * max_splats * kSplatFloats);
    const Block<uint32_t> indices = allocate<uint32_t>(threads * (max_splats + 1));
#pragma omp parallel for schedule(dynamic)
    for (int tile = 0; tile < tiles; ++tile) {
        const size_t thread = static_cast<size_t>(omp_get_thread_num());
        kernels().blend(frame_, tile, splats.get() + thread * max_splats * kSplatFloats,
                        indices.get() + thread * (max_splats + 1));
    }
}

void Rasterizer::project() {
    groups_ = (frame_.model.count + kGroup - 1) / kGroup;
    const size_t slots = static_cast<size_t>(groups_) * kGroup;
    if (boxes_.size() < slots) {
        splats_.resize(slots * kSplatFloats);
        depths_.resize(slots), ids_.resize(slots), first_.resize(slots), count_.resize(slots);
        boxes_.resize(slots);  // the last: its size shows that all allocations succeeded
    }
    drawn_.resize(groups_), rows_.resize(groups_ + 1);
    frame_.splats = splats_.data(), frame_.depths = depths_.data(), frame_.boxes = boxes_.data();
    frame_.ids = ids_.data(), frame_.drawn = drawn_.data();
#pragma omp parallel for schedule(dynamic, 4)
    for (int64_t group = 0; group < groups_; ++group) drawn_[group] = kernels().project(frame_, group);
    rows_[0] = 0;
    for (int64_t group = 0; group < groups_; ++group) rows_[group + 1] = rows_[group] + drawn_[group];
}

// The bits of positive floats have the order of their values. A counting sort by one digit after another is stable, so
// equal depths keep the order of their slots, which is that of the Gaussians.
void Rasterizer::sort_by_depth() {
    constexpr int kDigit = 13;
    const size_t count = drawn();
    keys_.resize(count), sorted_.resize(count), order_.resize(count);
    uint32_t min_bits = UINT32_MAX, max_bits = 0;
    size_t at = 0;
    for (int64_t group = 0; group < groups_; ++group)
        for (int i = 0; i < drawn_[group]; ++i) {
            const auto slot = static_cast<uint32_t>(group * kGroup + i);
            uint32_t bits;
            std::memcpy(&bits, &depths_[slot], sizeof bits);
            min_bits = std::min(min_bits, bits), max_bits = std::max(max_bits, bits);
            keys_[at++] = static_cast<uint64_t>(bits) << 32 | slot;
        }
    std::vector<uint32_t> positions(size_t{1} << kDigit);
    for (int shift = 0; shift < 32 && count > 0 && (max_bits - min_bits) >> shift > 0; shift += kDigit) {
        const auto digit = [&](uint64_t key) {
            return (static_cast<uint32_t>(key >> 32) - min_bits) >> shift & ((1u << kDigit) - 1u);
        };
        std::fill(positions.begin(), positions.end(), 0);
        for (const uint64_t key : keys_) ++positions[digit(key)];
        uint32_t before = 0;
        for (uint32_t& w : positions) before += std::exchange(w, before);
        for (const uint64_t key : keys_) sorted_[positions[digit(key)]++] = key;
        keys_.swap(sorted_);
    }
    for (size_t i = 0; i < count; ++i) order_[i] = static_cast<uint32_t>(keys_[i]);
}

// The instances of a range of the depth order, splat by splat and tile by tile.
void Rasterizer::fill(Part& part, int64_t begin, int64_t end) {
    part.count = 0;
    part.next.assign(static_cast<size_t>(frame_.tiles_across) * frame_.tiles_down, 0);
    for (int64_t rank = begin; rank < end; ++rank) {
        const uint32_t slot = order_[rank];
        const Box& box = boxes_[slot];
        const size_t max_count =
            part.count + static_cast<size_t>(box.right - box.left + 1) * (box.bottom - box.top + 1);
        if (part.tiles.size() < max_count) {
            const size_t room = max_count + max_count / 2;
            part.slots.resize(room), part.blocks.resize(room);
            part.tiles.resize(room);  // the last: its size shows that all allocations succeeded
        }
        const int covered = kernels().cover(frame_, slot, &part.tiles[part.count], &part.blocks[part.count]);
        first_[slot] = static_cast<uint32_t>(part.count), count_[slot] = static_cast<uint32_t>(covered);
        for (int i = 0; i < covered; ++i, ++part.count) {
            part.slots[part.count] = slot;
            ++part.next[part.tiles[part.count]];
        }
    }
}

// Sorts the instances by tile and, within a tile, by depth. The depth order is cut into parts; the position of an
// instance does not depend on their number.
void Rasterizer::distribute() {
    const int tiles = frame_.tiles_across * frame_.tiles_down;
    const int64_t count = static_cast<int64_t>(drawn());
    const int part_count = static_cast<int>(std::clamp<int64_t>(count / 256, 1, 4 * omp_get_max_threads()));
    parts_.resize(part_count);
    FirstError error;
#pragma omp parallel for schedule(dynamic)
    for (int p = 0; p < part_count; ++p)
        error.guard([&] { fill(parts_[p], count * p / part_count, count * (p + 1) / part_count); });
    error.rethrow();
    size_t total = 0;
    for (const Part& part : parts_) total += part.count;
    if (total > UINT32_MAX)
        throw std::length_error("more than 2^32 pairs of a Gaussian and a tile: use fewer Gaussians");
    starts_.resize(tiles + 1);
    uint32_t before = 0;
    for (int tile = 0; tile < tiles; ++tile) {
        starts_[tile] = before;
        for (Part& part : parts_) before += std::exchange(part.next[tile], before);
    }
    starts_[tiles] = before;
    instances_.resize(total);
    std::vector<uint32_t> emission_offsets(part_count + 1);
    for (int p = 0; p < part_count; ++p)
        emission_offsets[p + 1] = emission_offsets[p] + static_cast<uint32_t>(parts_[p].count);
#pragma omp parallel for schedule(dynamic)
    for (int p = 0; p < part_count; ++p) {
        Part& part = parts_[p];
        for (size_t i = 0; i < part.count; ++i)
            instances_[part.next[part.tiles[i]]++] = {part.slots[i], emission_offsets[p] + static_cast<uint32_t>(i),
                                                      part.blocks[i]};
        for (int64_t rank = count * p / part_count; rank < count * (p + 1) / part_count; ++rank)
            first_[order_[rank]] += emission_offsets[p];
    }
    frame_.instances = instances_.data(), frame_.starts = starts_.data();
}

void Rasterizer::write_ids(int64_t* ids) const {
    for (int64_t group = 0; group < groups_; ++group)
        for (int i = 0; i < drawn_[group]; ++i) *ids++ = ids_[group * kGroup + i];
}

size_t Rasterizer::bytes() const {
    const auto bytes_of = [](const auto& vector) { return vector.capacity() * sizeof(vector[0]); };
    size_t total = bytes_of(splats_) + bytes_of(depths_) + bytes_of(boxes_) + bytes_of(ids_) + bytes_of(first_) +
                   bytes_of(count_) + bytes_of(order_) + bytes_of(keys_) + bytes_of(sorted_) + bytes_of(instances_) +
                   bytes_of(starts_) + bytes_of(moments_);
    for (const Part& part : parts_)
        total += bytes_of(part.slots) + bytes_of(part.tiles) + bytes_of(part.blocks) + bytes_of(part.next);
    return total;
}

void Rasterizer::backward(const ImageGradients& grad, const ModelGradients& out) {
    const size_t width = kMomentFloats[frame_.geometry];
    moments_.resize(std::max(moments_.size(), instances_.size() * width));
    const int tiles = frame_.tiles_across * frame_.tiles_down;
#pragma omp parallel for schedule(dynamic)
    for (int tile = 0; tile < tiles; ++tile) kernels().blend_gradient(frame_, grad, tile, moments_.data());
#pragma omp parallel for schedule(dynamic, 4)
    for (int64_t group = 0; group < groups_; ++group)
        kernels().project_gradient(frame_, group, moments_.data(), first_.data(), count_.data(), rows_[group], out);
}

LossParts image_loss(const float* x, const float* y, int height, int width, float weight, float* gradient) {
    kernels();
    const int length = 3 * width;
    const size_t size = static_cast<size_t>(height) * length;
    std::vector<float> grad_mean(size), grad_square(size), grad_product(size);
    std::vector<double> sums(2 * static_cast<size_t>(height));
    const size_t room = 4 * static_cast<size_t>(length + 64);  // floats per thread
    const Block<float> scratch = allocate<float>(room * static_cast<size_t>(omp_get_max_threads()));
#pragma omp parallel
    {
        float* own = scratch.get() + room * static_cast<size_t>(omp_get_thread_num());
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row) {
            const size_t at = static_cast<size_t>(length) * row;
            kernels().similarity(x, y, height, length, row, own, grad_mean.data() + at, grad_square.data() + at,
                                 grad_product.data() + at, sums.data() + 2 * row);
        }
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row)
            kernels().loss_gradient(x, y, height, length, row, weight, own, grad_mean.data(), grad_square.data(),
                                    grad_product.data(), gradient);
    }
    LossParts total{0.0, 0.0};
    for (int row = 0; row < height; ++row) total.difference += sums[2 * row], total.similarity += sums[2 * row + 1];
    return {total.difference / static_cast<double>(size), total.similarity / static_cast<double>(size)};
}

}  // namespace pcbench::splat
