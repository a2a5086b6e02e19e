// A tree of boxes over triangles: four children a node, their float32 boxes side by side for the CPU's vector unit.
//
// Boxes only decide what is looked at: they are a little larger than what they hold, so that the answer is the one that
// looking at every triangle in float64 would give, to the last bit, whatever the tree's shape or the threads.
#pragma once
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <new>
#include <vector>

#include "common/interrupt.h"
#include "mesh/ray.h"
#include "mesh/triangle.h"

namespace pcbench::mesh {

typedef float Float4 __attribute__((vector_size(16)));

inline Float4 larger(Float4 a, Float4 b) { return a > b ? a : b; }
inline Float4 smaller(Float4 a, Float4 b) { return a < b ? a : b; }
inline Float4 all(float value) { return Float4{value, value, value, value}; }

// Child k is a node if count[k] is 0, else the triangles first[k], first[k] + 1, ... Two cache lines.
struct alignas(64) Node {
    Float4 low[3], high[3];
    uint32_t first[4], count[4];
};

struct Box {
    float low[3] = {HUGE_VALF, HUGE_VALF, HUGE_VALF}, high[3] = {-HUGE_VALF, -HUGE_VALF, -HUGE_VALF};

    void include(const float* l, const float* h) {
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = std::min(low[axis], l[axis]);
            high[axis] = std::max(high[axis], h[axis]);
        }
    }
    float half_area() const {
        const float x = high[0] - low[0], y = high[1] - low[1], z = high[2] - low[2];
        return x * y + y * z + z * x;
    }
};

// From the file's coordinates to those of the boxes: centred, and scaled by a power of two to about one.
struct Frame {
    double origin[3], scale;
};

// ---- build ----------------------------------------------------------------------------------------------------------

struct Item {  // a triangle while the tree is built
    Box box;
    uint32_t face;
    float twice_centre(int axis) const { return box.low[axis] + box.high[axis]; }
};

class Builder {
public:
    static constexpr uint32_t kLeaf = 2;             // triangles at most
    static constexpr uint32_t kUninterrupted = 256;  // triangles that take no time worth asking after
    static constexpr int kBins = 12;                 // candidates for a cut
    static constexpr int kHalving = 40;              // levels after which ranges are halved, which bounds the depth
    static constexpr int kDepth = kHalving + 32;     // levels at most

    Builder(std::vector<Item>& items, Interrupt& interrupt) : items_(items), interrupt_(interrupt) {}

    // The nodes in an order that depends on the triangles alone; the first is the root. Not all of them when
    // interrupted.
    std::vector<Node> build() {
        const uint32_t size = static_cast<uint32_t>(items_.size());
        std::vector<Node> nodes;
        std::vector<Job> jobs;
        grow(nodes, Range(items_, 0, size), 0, std::max(1u << 14, size / 64), &jobs);
        std::vector<std::vector<Node>> parts(jobs.size());
        std::atomic<bool> out_of_memory{false};  // no exception may leave a parallel region
#pragma omp parallel for schedule(dynamic, 1)
        for (size_t j = 0; j < jobs.size(); ++j) {
            if (out_of_memory) continue;
            try {
                grow(parts[j], jobs[j].range, jobs[j].depth, 0, nullptr);
            } catch (const std::bad_alloc&) {
                out_of_memory = true;
            }
        }
        if (out_of_memory) throw std::bad_alloc();
        for (size_t j = 0; j < jobs.size(); ++j) {
            const uint32_t offset = static_cast<uint32_t>(nodes.size());
            nodes[jobs[j].node].first[jobs[j].slot] = offset;
            for (Node& node : parts[j]) {
                for (int k = 0; k < 4; ++k)
                    if (node.count[k] == 0) node.first[k] += offset;
                nodes.push_back(node);
            }
        }
        return nodes;
    }

private:
    struct Range {
        uint32_t begin = 0, end = 0;
        Box box;
        Range() = default;
        Range(const std::vector<Item>& items, uint32_t b, uint32_t e) : begin(b), end(e) {
            for (uint32_t i = b; i < e; ++i) box.include(items[i].box.low, items[i].box.high);
        }
        uint32_t size() const { return end - begin; }
    };
    struct Job {  // a subtree left for a thread
        Range range;
        int depth;
        uint32_t node;
        int slot;
    };

    // Ranges of at most `small` triangles are not grown but noted in `jobs`.
    uint32_t grow(std::vector<Node>& nodes, const Range& range, int depth, uint32_t small, std::vector<Job>* jobs) {
        if (range.size() > kUninterrupted && interrupt_.requested()) return 0;
        Range children[4];
        children[0] = range;
        int count = 1;
        while (count < 4) {  // cut the child that most queries would enter
            int widest = -1;
            for (int k = 0; k < count; ++k)
                if (children[k].size() > kLeaf &&
                    (widest < 0 || children[k].box.half_area() > children[widest].box.half_area()))
                    widest = k;
            if (widest < 0) break;
            const Range whole = children[widest];
            const uint32_t middle = depth < kHalving ? cut(whole) : halve(whole);
            children[widest] = Range(items_, whole.begin, middle);
            children[count++] = Range(items_, middle, whole.end);
        }
        const uint32_t index = static_cast<uint32_t>(nodes.size());
        nodes.emplace_back();
        for (int k = 0; k < 4; ++k) {
            const Range& child = children[k];
            const bool leaf = child.size() <= kLeaf;  // an empty one too: its box is nowhere
            for (int axis = 0; axis < 3; ++axis) {
                nodes[index].low[axis][k] = child.box.low[axis];
                nodes[index].high[axis][k] = child.box.high[axis];
            }
            nodes[index].first[k] = child.begin;
            nodes[index].count[k] = child.size() ? child.size() : 1;
            if (leaf) continue;
            nodes[index].count[k] = 0;
            if (jobs && child.size() <= small)
                jobs->push_back({child, depth + 1, index, k});
            else {
                const uint32_t at = grow(nodes, child, depth + 1, small, jobs);
                nodes[index].first[k] = at;
            }
        }
        return index;
    }

    // The binned surface area heuristic: Wald, "On fast construction of SAH-based bounding volume hierarchies", 2007.
    uint32_t cut(const Range& range) {
        float low[3], high[3];
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = HUGE_VALF, high[axis] = -HUGE_VALF;
            for (uint32_t i = range.begin; i < range.end; ++i) {
                const float centre = items_[i].twice_centre(axis);
                low[axis] = std::min(low[axis], centre), high[axis] = std::max(high[axis], centre);
            }
        }
        int axis = 0;
        for (int other = 1; other < 3; ++other)
            if (high[other] - low[other] > high[axis] - low[axis]) axis = other;
        const float scale = kBins / (high[axis] - low[axis]);
        if (!(scale < std::numeric_limits<float>::max())) return halve(range);
        const auto bin = [&](const Item& item) {
            return std::min(kBins - 1, static_cast<int>((item.twice_centre(axis) - low[axis]) * scale));
        };
        Box boxes[kBins];
        uint32_t counts[kBins] = {};
        for (uint32_t i = range.begin; i < range.end; ++i) {
            const int b = bin(items_[i]);
            boxes[b].include(items_[i].box.low, items_[i].box.high);
            ++counts[b];
        }
        float below[kBins];  // cost of all bins up to this one
        Box box;
        uint32_t count = 0;
        for (int b = 0; b < kBins; ++b) {
            box.include(boxes[b].low, boxes[b].high);
            count += counts[b];
            below[b] = count ? count * box.half_area() : 0;
        }
        box = Box(), count = 0;
        float best = HUGE_VALF;
        int last = -1;  // bin of the left side
        for (int b = kBins - 1; b > 0; --b) {
            box.include(boxes[b].low, boxes[b].high);
            count += counts[b];
            if (count == 0 || count == range.size()) continue;
            const float cost = below[b - 1] + count * box.half_area();
            if (cost < best) best = cost, last = b - 1;
        }
        if (last < 0) return halve(range);
        const auto middle = std::partition(items_.begin() + range.begin, items_.begin() + range.end,
                                           [&](const Item& item) { return bin(item) <= last; });
        return static_cast<uint32_t>(middle - items_.begin());
    }

    static uint32_t halve(const Range& range) { return range.begin + range.size() / 2; }

    std::vector<Item>& items_;
    Interrupt& interrupt_;
};

// ---- order ----------------------------------------------------------------------------------------------------------

inline uint32_t spread_bits(uint32_t value) {  // ten bits to every third place
    value = (value | value << 16) & 0x030000FFu;
    value = (value | value << 8) & 0x0300F00Fu;
    value = (value | value << 4) & 0x030C30C3u;
    return (value | value << 2) & 0x09249249u;
}

// Indices of the points along a Morton curve: neighbours in it are neighbours in space.
inline std::vector<uint32_t> morton_order(const double* points, size_t count) {
    double low[3], high[3];
    for (int axis = 0; axis < 3; ++axis) low[axis] = HUGE_VAL, high[axis] = -HUGE_VAL;
    for (size_t i = 0; i < count; ++i)
        for (int axis = 0; axis < 3; ++axis) {
            low[axis] = std::min(low[axis], points[3 * i + axis]);
            high[axis] = std::max(high[axis], points[3 * i + axis]);
        }
    double widest = 0;
    for (int axis = 0; axis < 3; ++axis) widest = std::max(widest, high[axis] - low[axis]);
    const double scale = widest > 0 ? 1023.0 / widest : 0.0;
    std::vector<uint64_t> keys(count), other(count);
    for (size_t i = 0; i < count; ++i) {
        uint32_t code = 0;
        for (int axis = 0; axis < 3; ++axis)
            code |= spread_bits(static_cast<uint32_t>((points[3 * i + axis] - low[axis]) * scale)) << axis;
        keys[i] = static_cast<uint64_t>(code) << 32 | i;
    }
    for (int shift = 32; shift < 62; shift += 10) {  // a radix sort, ten bits at a time
        size_t starts[1025] = {};
        for (uint64_t key : keys) ++starts[(key >> shift & 1023) + 1];
        for (int b = 0; b < 1024; ++b) starts[b + 1] += starts[b];
        for (uint64_t key : keys) other[starts[key >> shift & 1023]++] = key;
        keys.swap(other);
    }
    return std::vector<uint32_t>(keys.begin(), keys.end());
}

// ---- query ----------------------------------------------------------------------------------------------------------

class MeshIndex {
public:
    // vertices (V, 3), finite; faces (F, 3), indices in range, 1 <= F < 2^31. Not to be used when interrupted.
    MeshIndex(const double* vertices, size_t vertex_count, const int64_t* faces, size_t face_count,
              Interrupt& interrupt) {
        frame_ = frame_of(vertices, vertex_count);
        std::vector<Item> items(face_count);
#pragma omp parallel for schedule(static)
        for (size_t f = 0; f < face_count; ++f) {
            items[f].face = static_cast<uint32_t>(f);
            for (int corner = 0; corner < 3; ++corner) {
                float low[3], high[3];
                for (int axis = 0; axis < 3; ++axis) {
                    const double at = (vertices[3 * faces[3 * f + corner] + axis] - frame_.origin[axis]) * frame_.scale;
                    low[axis] = round_down(at - kSlack), high[axis] = round_up(at + kSlack);
                }
                items[f].box.include(low, high);
            }
        }
        nodes_ = Builder(items, interrupt).build();
        if (interrupt.requested()) return;
        triangles_.resize(face_count);
        faces_.resize(face_count);
#pragma omp parallel for schedule(static)
        for (size_t i = 0; i < face_count; ++i) {
            const int64_t* corners = faces + 3 * static_cast<size_t>(items[i].face);
            const auto vertex = [&](int k) { return vec3(vertices + 3 * corners[k]); };
            triangles_[i] = {vertex(0), vertex(1), vertex(2)};
            faces_[i] = items[i].face;
        }
    }

    size_t size() const { return faces_.size(); }

    // For each of `count` < 2^32 points: distance, nearest point, face (the lowest of equals) and feature on it.
    void query(const double* points, size_t count, double* distances, double* closest, int64_t* faces,
               uint8_t* features, Interrupt& interrupt) const {
        constexpr size_t kChunk = 512;
        const std::vector<uint32_t> order = morton_order(points, count);
        const int64_t chunks = static_cast<int64_t>((count + kChunk - 1) / kChunk);
#pragma omp parallel for schedule(dynamic, 1)
        for (int64_t chunk = 0; chunk < chunks; ++chunk) {
            const size_t begin = chunk * kChunk, end = std::min(count, begin + kChunk);
            uint32_t triangle = 0;  // the answer to the query before: a good first bound
            for (size_t i = begin; i < end; ++i) {
                if (i % kAsk == 0 && interrupt.requested()) break;
                const size_t row = order[i];
                const Vec3 p = vec3(points + 3 * row);
                triangle = search(p, triangle);
                const Nearest nearest = nearest_on_triangle(p, triangles_[triangle]);
                distances[row] = std::sqrt(nearest.squared);
                write(nearest.closest, closest + 3 * row);
                faces[row] = faces_[triangle];
                features[row] = nearest.feature;
            }
        }
    }

    // Where each of `count` rays origin + t * direction first meets the mesh with t in (0, limit): t and the face, the
    // lowest of equals; infinity and -1 where it meets none. Neighbours in the arrays should be neighbours in space.
    void cast(const double* origins, const double* directions, size_t count, double limit, double* distances,
              int64_t* faces, Interrupt& interrupt) const {
        each_ray(origins, directions, count, interrupt, [&](size_t row, const Ray& ray) {
            const RayHit hit = first_hit(ray, limit, false);
            distances[row] = hit.face < 0 ? HUGE_VAL : hit.t;
            faces[row] = hit.face;
        });
    }

    // Whether each ray meets the mesh at all with t in (0, limit): stops at the first triangle found.
    void blocked(const double* origins, const double* directions, size_t count, double limit, bool* blocked,
                 Interrupt& interrupt) const {
        each_ray(origins, directions, count, interrupt,
                 [&](size_t row, const Ray& ray) { blocked[row] = first_hit(ray, limit, true).face >= 0; });
    }

private:
    template <typename Visit>
    static void each_ray(const double* origins, const double* directions, size_t count, Interrupt& interrupt,
                         Visit visit) {
        constexpr size_t kChunk = 1024;
        const int64_t chunks = static_cast<int64_t>((count + kChunk - 1) / kChunk);
#pragma omp parallel for schedule(dynamic, 1)
        for (int64_t chunk = 0; chunk < chunks; ++chunk)
            for (size_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk); ++i) {
                if (i % kAsk == 0 && interrupt.requested()) break;
                visit(i, Ray(vec3(origins + 3 * i), vec3(directions + 3 * i)));
            }
    }

    struct RayHit {
        double t;
        int64_t face;
    };
    struct RayEntry {
        float t;
        uint32_t first, count;
    };

    RayHit first_hit(const Ray& ray, double limit, bool any) const {
        // Slabs in float32, as Ize, "Robust BVH ray traversal", 2013: the origin is an interval that holds the true
        // one, the three roundings that are left are relative and covered by kRayMargin.
        Float4 low_origin[3], high_origin[3], inverse[3];
        const double o[3] = {ray.origin.x, ray.origin.y, ray.origin.z};
        const double d[3] = {ray.direction.x, ray.direction.y, ray.direction.z};
        for (int axis = 0; axis < 3; ++axis) {
            const double centred = (o[axis] - frame_.origin[axis]) * frame_.scale;
            const float at = static_cast<float>(centred), error = std::fabs(at) * 0x1p-23f;
            low_origin[axis] = all(at - error), high_origin[axis] = all(at + error);
            // Never infinite: 0 * inf would be NaN on the face of a box.
            const double slope = d[axis] * frame_.scale;
            const double safe = std::fabs(slope) < 1e-18 ? std::copysign(1e-18, slope) : slope;
            inverse[axis] = all(static_cast<float>(std::copysign(std::min(1 / std::fabs(safe), 1e18), safe)));
        }
        RayHit best{limit, -1};
        float bound = to_bound(limit);
        RayEntry stack[3 * Builder::kDepth + 1];
        int top = 0;
        stack[top++] = {0, 0, 0};
        while (top > 0) {
            const RayEntry entry = stack[--top];
            if (entry.t > bound) continue;
            for (uint32_t i = entry.first; i < entry.first + entry.count; ++i) {
                const double t = ray.meets(triangles_[i]);
                const int64_t face = faces_[i];
                if (!(t > 0) || !(t < best.t || (t == best.t && best.face >= 0 && face < best.face))) continue;
                best = {t, face};
                if (any) return best;
                bound = to_bound(t);
            }
            if (entry.count) continue;
            const Node& node = nodes_[entry.first];
            Float4 enter = all(0), leave = all(std::numeric_limits<float>::max());
            for (int axis = 0; axis < 3; ++axis) {
                const Float4 a = (node.low[axis] - high_origin[axis]) * inverse[axis];
                const Float4 b = (node.high[axis] - low_origin[axis]) * inverse[axis];
                enter = larger(enter, smaller(a, b)), leave = smaller(leave, larger(a, b));
            }
            leave = leave * all(kRayMargin);
            const int pushed = top;
            for (int k = 0; k < 4; ++k) {
                if (!(enter[k] <= leave[k]) || enter[k] > bound) continue;
                int place = top++;  // the nearest last, so that it is taken first
                for (; place > pushed && stack[place - 1].t < enter[k]; --place) stack[place] = stack[place - 1];
                stack[place] = {enter[k], node.first[k], node.count[k]};
            }
        }
        return best;
    }

    static constexpr size_t kAsk = 16;  // queries between two looks at the interrupt

    static float to_bound(double t) { return static_cast<float>(std::min(t * kRayMargin, 1e38)); }

    static constexpr float kRayMargin = 1 + 0x1p-20f;
    // Far above the rounding of float64 differences at the size of the mesh, which is about one in the boxes' frame.
    static constexpr double kSlack = 0x1p-40;
    // Float32 sums of three squares are good to 3e-7: a box must be farther by more than that to be left out.
    static constexpr double kMargin = 1 + 1e-6;

    struct Entry {
        float squared;
        uint32_t first, count;
    };

    static float round_down(double value) {
        const float near = static_cast<float>(value);
        return near > value ? std::nextafterf(near, -HUGE_VALF) : near;
    }
    static float round_up(double value) { return -round_down(-value); }

    static Frame frame_of(const double* vertices, size_t count) {
        Frame frame{{0, 0, 0}, 1};
        double widest = 0;
        for (int axis = 0; axis < 3; ++axis) {
            double low = HUGE_VAL, high = -HUGE_VAL;
            for (size_t i = 0; i < count; ++i) {
                low = std::min(low, vertices[3 * i + axis]), high = std::max(high, vertices[3 * i + axis]);
            }
            frame.origin[axis] = low / 2 + high / 2;
            widest = std::max(widest, high - low);
        }
        if (widest > 0) frame.scale = std::ldexp(1.0, -std::ilogb(widest));
        return frame;
    }

    // The triangle, by its place in the tree's order, nearest to p; `start` is any of them.
    uint32_t search(const Vec3& p, uint32_t start) const {
        const double centred[3] = {p.x - frame_.origin[0], p.y - frame_.origin[1], p.z - frame_.origin[2]};
        Float4 low[3], high[3];  // an interval of float32 that holds the query
        for (int axis = 0; axis < 3; ++axis) {
            const float at = static_cast<float>(centred[axis] * frame_.scale), error = std::fabs(at) * 0x1p-23f;
            low[axis] = all(at - error), high[axis] = all(at + error);
        }
        const double to_boxes = frame_.scale * frame_.scale * kMargin;
        uint32_t best = start;
        double squared = nearest_on_triangle(p, triangles_[start]).squared;
        float bound = static_cast<float>(squared * to_boxes);

        Entry stack[3 * Builder::kDepth + 1];
        int top = 0;
        stack[top++] = {0, 0, 0};
        while (top > 0) {
            const Entry entry = stack[--top];
            if (entry.squared > bound) continue;
            for (uint32_t i = entry.first; i < entry.first + entry.count; ++i) {
                const double candidate = nearest_on_triangle(p, triangles_[i]).squared;
                if (candidate < squared || (candidate == squared && faces_[i] < faces_[best])) {
                    best = i, squared = candidate;
                    bound = static_cast<float>(squared * to_boxes);
                }
            }
            if (entry.count) continue;
            const Node& node = nodes_[entry.first];
            Float4 sum = all(0);
            for (int axis = 0; axis < 3; ++axis) {
                const Float4 gap = larger(larger(node.low[axis] - high[axis], low[axis] - node.high[axis]), all(0));
                sum += gap * gap;
            }
            const int pushed = top;
            for (int k = 0; k < 4; ++k) {
                if (sum[k] > bound) continue;
                int place = top++;  // the nearest last, so that it is taken first
                for (; place > pushed && stack[place - 1].squared < sum[k]; --place) stack[place] = stack[place - 1];
                stack[place] = {sum[k], node.first[k], node.count[k]};
            }
        }
        return best;
    }

    Frame frame_;
    std::vector<Node> nodes_;
    std::vector<Triangle> triangles_;  // in the tree's order
    std::vector<uint32_t> faces_;      // their numbers
};

}  // namespace pcbench::mesh
