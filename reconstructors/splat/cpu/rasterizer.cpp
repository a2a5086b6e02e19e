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

void Rasterizer::forward(const Model& model, const Pinhole& pinhole, const float* background, const Pictures& pictures,
                         bool geometry) {
    kernels();  // where the environment names some that do not run here, this throws before threads start
    frame_.model = model;
    frame_.pinhole = pinhole;
    std::copy_n(background, 3, frame_.background);
    frame_.tiles_across = (pinhole.width + kTile - 1) / kTile;
    frame_.tiles_down = (pinhole.height + kTile - 1) / kTile;
    frame_.geometry = geometry;
    frame_.pictures = pictures;
    project();
    sort_by_depth();
    distribute();
    const int tiles = frame_.tiles_across * frame_.tiles_down;
    // Room for each thread, taken before any of them starts: a tile's splats, and a list of them.
    size_t most = 1;
    for (int tile = 0; tile < tiles; ++tile) most = std::max<size_t>(most, starts_[tile + 1] - starts_[tile]);
    const size_t threads = static_cast<size_t>(omp_get_max_threads());
    const Block<float> splats = allocate<float>(threads * most * kSplatFloats);
    const Block<uint32_t> listed = allocate<uint32_t>(threads * (most + 1));
#pragma omp parallel for schedule(dynamic)
    for (int tile = 0; tile < tiles; ++tile) {
        const size_t thread = static_cast<size_t>(omp_get_thread_num());
        kernels().blend(frame_, tile, splats.get() + thread * most * kSplatFloats, listed.get() + thread * (most + 1));
    }
}

void Rasterizer::project() {
    groups_ = (frame_.model.count + kGroup - 1) / kGroup;
    const size_t slots = static_cast<size_t>(groups_) * kGroup;
    if (boxes_.size() < slots) {
        splats_.resize(slots * kSplatFloats);
        depths_.resize(slots), ids_.resize(slots), first_.resize(slots), count_.resize(slots);
        boxes_.resize(slots);  // the last: it says that there was memory for all of them
    }
    drawn_.resize(groups_), rows_.resize(groups_ + 1);
    frame_.splats = splats_.data(), frame_.depths = depths_.data(), frame_.boxes = boxes_.data();
    frame_.ids = ids_.data(), frame_.drawn = drawn_.data();
#pragma omp parallel for schedule(dynamic, 4)
    for (int64_t group = 0; group < groups_; ++group) drawn_[group] = kernels().project(frame_, group);
    rows_[0] = 0;
    for (int64_t group = 0; group < groups_; ++group) rows_[group + 1] = rows_[group] + drawn_[group];
}

// The bits of positive floats are in the order of their values. Counting sort by one digit after another is stable, so
// equal depths stay in the order of their slots, which is that of the Gaussians.
void Rasterizer::sort_by_depth() {
    constexpr int kDigit = 13;
    const size_t count = drawn();
    keys_.resize(count), sorted_.resize(count), order_.resize(count);
    uint32_t least = UINT32_MAX, most = 0;
    size_t at = 0;
    for (int64_t group = 0; group < groups_; ++group)
        for (int i = 0; i < drawn_[group]; ++i) {
            const auto slot = static_cast<uint32_t>(group * kGroup + i);
            uint32_t bits;
            std::memcpy(&bits, &depths_[slot], sizeof bits);
            least = std::min(least, bits), most = std::max(most, bits);
            keys_[at++] = static_cast<uint64_t>(bits) << 32 | slot;
        }
    std::vector<uint32_t> where(size_t{1} << kDigit);
    for (int shift = 0; shift < 32 && count > 0 && (most - least) >> shift > 0; shift += kDigit) {
        const auto digit = [&](uint64_t key) {
            return (static_cast<uint32_t>(key >> 32) - least) >> shift & ((1u << kDigit) - 1u);
        };
        std::fill(where.begin(), where.end(), 0);
        for (const uint64_t key : keys_) ++where[digit(key)];
        uint32_t before = 0;
        for (uint32_t& w : where) before += std::exchange(w, before);
        for (const uint64_t key : keys_) sorted_[where[digit(key)]++] = key;
        keys_.swap(sorted_);
    }
    for (size_t i = 0; i < count; ++i) order_[i] = static_cast<uint32_t>(keys_[i]);
}

// The instances of a range of the order of depth, tile by tile of each splat.
void Rasterizer::fill(Part& part, int64_t begin, int64_t end) {
    part.count = 0;
    part.next.assign(static_cast<size_t>(frame_.tiles_across) * frame_.tiles_down, 0);
    for (int64_t rank = begin; rank < end; ++rank) {
        const uint32_t slot = order_[rank];
        const Box& box = boxes_[slot];
        const size_t most = part.count + static_cast<size_t>(box.right - box.left + 1) * (box.bottom - box.top + 1);
        if (part.tiles.size() < most) {
            const size_t room = most + most / 2;
            part.slots.resize(room), part.blocks.resize(room);
            part.tiles.resize(room);  // the last: it says that there was memory for all of them
        }
        const int covered = kernels().cover(frame_, slot, &part.tiles[part.count], &part.blocks[part.count]);
        first_[slot] = static_cast<uint32_t>(part.count), count_[slot] = static_cast<uint32_t>(covered);
        for (int i = 0; i < covered; ++i, ++part.count) {
            part.slots[part.count] = slot;
            ++part.next[part.tiles[part.count]];
        }
    }
}

// The instances by tile, in each tile by depth. The order of depth is cut into parts; whatever their number, an
// instance comes to the same place.
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
    std::vector<uint32_t> emitted(part_count + 1);
    for (int p = 0; p < part_count; ++p) emitted[p + 1] = emitted[p] + static_cast<uint32_t>(parts_[p].count);
#pragma omp parallel for schedule(dynamic)
    for (int p = 0; p < part_count; ++p) {
        Part& part = parts_[p];
        for (size_t i = 0; i < part.count; ++i)
            instances_[part.next[part.tiles[i]]++] = {part.slots[i], emitted[p] + static_cast<uint32_t>(i),
                                                      part.blocks[i]};
        for (int64_t rank = count * p / part_count; rank < count * (p + 1) / part_count; ++rank)
            first_[order_[rank]] += emitted[p];
    }
    frame_.instances = instances_.data(), frame_.starts = starts_.data();
}

void Rasterizer::write_ids(int64_t* ids) const {
    for (int64_t group = 0; group < groups_; ++group)
        for (int i = 0; i < drawn_[group]; ++i) *ids++ = ids_[group * kGroup + i];
}

size_t Rasterizer::bytes() const {
    const auto held = [](const auto& vector) { return vector.capacity() * sizeof(vector[0]); };
    size_t total = held(splats_) + held(depths_) + held(boxes_) + held(ids_) + held(first_) + held(count_) +
                   held(order_) + held(keys_) + held(sorted_) + held(instances_) + held(starts_) + held(moments_);
    for (const Part& part : parts_) total += held(part.slots) + held(part.tiles) + held(part.blocks) + held(part.next);
    return total;
}

void Rasterizer::backward(const PictureGradients& by, const ModelGradients& out) {
    const size_t width = frame_.geometry ? kMomentFloats : kPlainMomentFloats;
    moments_.resize(std::max(moments_.size(), instances_.size() * width));
    const int tiles = frame_.tiles_across * frame_.tiles_down;
#pragma omp parallel for schedule(dynamic)
    for (int tile = 0; tile < tiles; ++tile) kernels().blend_gradient(frame_, by, tile, moments_.data());
#pragma omp parallel for schedule(dynamic, 4)
    for (int64_t group = 0; group < groups_; ++group)
        kernels().project_gradient(frame_, group, moments_.data(), first_.data(), count_.data(), rows_[group], out);
}

LossParts image_loss(const float* x, const float* y, int height, int width, float weight, float* gradient) {
    kernels();
    const int length = 3 * width;
    const size_t size = static_cast<size_t>(height) * length;
    std::vector<float> by_mean(size), by_square(size), by_product(size);
    std::vector<double> sums(2 * static_cast<size_t>(height));
    const size_t room = 4 * static_cast<size_t>(length + 64);  // floats of each thread
    const Block<float> scratch = allocate<float>(room * static_cast<size_t>(omp_get_max_threads()));
#pragma omp parallel
    {
        float* own = scratch.get() + room * static_cast<size_t>(omp_get_thread_num());
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row) {
            const size_t at = static_cast<size_t>(length) * row;
            kernels().similarity(x, y, height, length, row, own, by_mean.data() + at, by_square.data() + at,
                                 by_product.data() + at, sums.data() + 2 * row);
        }
#pragma omp for schedule(static)
        for (int row = 0; row < height; ++row)
            kernels().loss_gradient(x, y, height, length, row, weight, own, by_mean.data(), by_square.data(),
                                    by_product.data(), gradient);
    }
    LossParts total{0.0, 0.0};
    for (int row = 0; row < height; ++row) total.difference += sums[2 * row], total.similarity += sums[2 * row + 1];
    return {total.difference / static_cast<double>(size), total.similarity / static_cast<double>(size)};
}

}  // namespace pcbench::splat
