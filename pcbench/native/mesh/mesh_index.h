// Closest points on triangles and ray casting, by a tree of boxes.
//
// Boxes only prune. They are slightly enlarged, so that the result is bit-identical to a float64 search over all
// triangles, whatever the shape of the tree or the number of threads.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <vector>

#include "common/interrupt.h"
#include "mesh/morton_order.h"
#include "mesh/ray.h"
#include "mesh/tree.h"
#include "mesh/triangle.h"

namespace pcbench::mesh {

// Transform from mesh coordinates to those of the boxes: centred, and scaled by a power of two to a size of about one.
struct Frame {
    double origin[3], scale;
};

class MeshIndex {
public:
    // vertices (V, 3) are finite; faces (F, 3) are valid indices, 1 <= F < 2^31. An interrupted index must not be used.
    MeshIndex(const double* vertices, size_t vertex_count, const int64_t* faces, size_t face_count,
              Interrupt& interrupt) {
        frame_ = compute_frame(vertices, vertex_count);
        std::vector<Item> items(face_count);
#pragma omp parallel for schedule(static)
        for (size_t f = 0; f < face_count; ++f) {
            items[f].face = static_cast<uint32_t>(f);
            for (int corner = 0; corner < 3; ++corner) {
                float low[3], high[3];
                for (int axis = 0; axis < 3; ++axis) {
                    const double at = (vertices[3 * faces[3 * f + corner] + axis] - frame_.origin[axis]) * frame_.scale;
                    low[axis] = round_down(at - kBoxMargin), high[axis] = round_up(at + kBoxMargin);
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

    // For each of `count` < 2^32 points: distance, closest point, face (lowest index on ties) and feature on the face.
    void query(const double* points, size_t count, double* distances, double* closest, int64_t* faces,
               uint8_t* features, Interrupt& interrupt) const {
        constexpr size_t kChunk = 512;
        const std::vector<uint32_t> order = morton_order(points, count);
        const int64_t chunks = static_cast<int64_t>((count + kChunk - 1) / kChunk);
#pragma omp parallel for schedule(dynamic, 1)
        for (int64_t chunk = 0; chunk < chunks; ++chunk) {
            const size_t begin = chunk * kChunk, end = std::min(count, begin + kChunk);
            uint32_t triangle = 0;  // result of the previous query: a good first bound
            for (size_t i = begin; i < end; ++i) {
                if (i % kInterruptInterval == 0 && interrupt.requested()) break;
                const size_t row = order[i];
                const Vec3 p = vec3(points + 3 * row);
                triangle = closest_triangle(p, triangle);
                const ClosestPoint closest_point = closest_point_on_triangle(p, triangles_[triangle]);
                distances[row] = std::sqrt(closest_point.squared_distance);
                write(closest_point.point, closest + 3 * row);
                faces[row] = faces_[triangle];
                features[row] = closest_point.feature;
            }
        }
    }

    // First intersection of each of `count` rays origin + t * direction with the mesh, t in (0, limit): t and the face,
    // lowest index on ties; infinity and -1 if there is none. It is fastest if consecutive rays are close in space.
    void cast(const double* origins, const double* directions, size_t count, double limit, double* distances,
              int64_t* faces, Interrupt& interrupt) const {
        for_each_ray(origins, directions, count, interrupt, [&](size_t row, const Ray& ray) {
            const RayHit hit = first_hit(ray, limit, false);
            distances[row] = hit.face < 0 ? HUGE_VAL : hit.t;
            faces[row] = hit.face;
        });
    }

    // Whether each ray intersects the mesh with t in (0, limit). The search stops at the first triangle found.
    void blocked(const double* origins, const double* directions, size_t count, double limit, bool* blocked,
                 Interrupt& interrupt) const {
        for_each_ray(origins, directions, count, interrupt,
                     [&](size_t row, const Ray& ray) { blocked[row] = first_hit(ray, limit, true).face >= 0; });
    }

private:
    template <typename Visit>
    static void for_each_ray(const double* origins, const double* directions, size_t count, Interrupt& interrupt,
                             Visit visit) {
        constexpr size_t kChunk = 1024;
        const int64_t chunks = static_cast<int64_t>((count + kChunk - 1) / kChunk);
#pragma omp parallel for schedule(dynamic, 1)
        for (int64_t chunk = 0; chunk < chunks; ++chunk)
            for (size_t i = chunk * kChunk; i < std::min(count, (chunk + 1) * kChunk); ++i) {
                if (i % kInterruptInterval == 0 && interrupt.requested()) break;
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

    RayHit first_hit(const Ray& ray, double limit, bool any_hit) const {
        // Float32 slab test of Ize, "Robust BVH ray traversal", 2013: the origin is an interval that contains the true
        // one; the three remaining roundings are relative and covered by kRayMargin.
        Float4 low_origin[3], high_origin[3], inverse[3];
        const double o[3] = {ray.origin.x, ray.origin.y, ray.origin.z};
        const double d[3] = {ray.direction.x, ray.direction.y, ray.direction.z};
        for (int axis = 0; axis < 3; ++axis) {
            const double centred = (o[axis] - frame_.origin[axis]) * frame_.scale;
            const float at = static_cast<float>(centred), error = std::fabs(at) * 0x1p-23f;
            low_origin[axis] = broadcast(at - error), high_origin[axis] = broadcast(at + error);
            // Finite, since 0 * inf would be NaN on the face of a box.
            const double slope = d[axis] * frame_.scale;
            const double safe = std::fabs(slope) < 1e-18 ? std::copysign(1e-18, slope) : slope;
            inverse[axis] = broadcast(static_cast<float>(std::copysign(std::min(1 / std::fabs(safe), 1e18), safe)));
        }
        RayHit best{limit, -1};
        float bound = to_bound(limit);
        RayEntry stack[3 * Builder::kMaxDepth + 1];
        int top = 0;
        stack[top++] = {0, 0, 0};
        while (top > 0) {
            const RayEntry entry = stack[--top];
            if (entry.t > bound) continue;
            for (uint32_t i = entry.first; i < entry.first + entry.count; ++i) {
                const double t = ray.intersect(triangles_[i]);
                const int64_t face = faces_[i];
                if (!(t > 0) || !(t < best.t || (t == best.t && best.face >= 0 && face < best.face))) continue;
                best = {t, face};
                if (any_hit) return best;
                bound = to_bound(t);
            }
            if (entry.count) continue;
            const Node& node = nodes_[entry.first];
            Float4 enter = broadcast(0), leave = broadcast(std::numeric_limits<float>::max());
            for (int axis = 0; axis < 3; ++axis) {
                const Float4 a = (node.low[axis] - high_origin[axis]) * inverse[axis];
                const Float4 b = (node.high[axis] - low_origin[axis]) * inverse[axis];
                enter = maximum(enter, minimum(a, b)), leave = minimum(leave, maximum(a, b));
            }
            leave = leave * broadcast(kRayMargin);
            const int pushed = top;
            for (int k = 0; k < 4; ++k) {
                if (!(enter[k] <= leave[k]) || enter[k] > bound) continue;
                int slot = top++;  // insertion sort: the nearest child ends on top of the stack
                for (; slot > pushed && stack[slot - 1].t < enter[k]; --slot) stack[slot] = stack[slot - 1];
                stack[slot] = {enter[k], node.first[k], node.count[k]};
            }
        }
        return best;
    }

    static constexpr size_t kInterruptInterval = 16;  // queries between two checks for an interrupt

    static float to_bound(double t) { return static_cast<float>(std::min(t * kRayMargin, 1e38)); }

    static constexpr float kRayMargin = 1 + 0x1p-20f;
    // Enlargement of boxes: far above the rounding of float64 at the size of the mesh, about one in box coordinates.
    static constexpr double kBoxMargin = 0x1p-40;
    // A float32 sum of three squares has a relative error of up to 3e-7; a box is pruned only beyond this margin.
    static constexpr double kDistanceMargin = 1 + 1e-6;

    struct Entry {
        float squared;
        uint32_t first, count;
    };

    static float round_down(double value) {
        const float near = static_cast<float>(value);
        return near > value ? std::nextafterf(near, -HUGE_VALF) : near;
    }
    static float round_up(double value) { return -round_down(-value); }

    static Frame compute_frame(const double* vertices, size_t count) {
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

    // Position in the tree's order of the triangle closest to p; the search starts with the bound of triangle `start`.
    uint32_t closest_triangle(const Vec3& p, uint32_t start) const {
        const double centred[3] = {p.x - frame_.origin[0], p.y - frame_.origin[1], p.z - frame_.origin[2]};
        Float4 low[3], high[3];  // float32 interval that contains the query
        for (int axis = 0; axis < 3; ++axis) {
            const float at = static_cast<float>(centred[axis] * frame_.scale), error = std::fabs(at) * 0x1p-23f;
            low[axis] = broadcast(at - error), high[axis] = broadcast(at + error);
        }
        const double to_box_units = frame_.scale * frame_.scale * kDistanceMargin;
        uint32_t best = start;
        double squared = closest_point_on_triangle(p, triangles_[start]).squared_distance;
        float bound = static_cast<float>(squared * to_box_units);

        Entry stack[3 * Builder::kMaxDepth + 1];
        int top = 0;
        stack[top++] = {0, 0, 0};
        while (top > 0) {
            const Entry entry = stack[--top];
            if (entry.squared > bound) continue;
            for (uint32_t i = entry.first; i < entry.first + entry.count; ++i) {
                const double candidate = closest_point_on_triangle(p, triangles_[i]).squared_distance;
                if (candidate < squared || (candidate == squared && faces_[i] < faces_[best])) {
                    best = i, squared = candidate;
                    bound = static_cast<float>(squared * to_box_units);
                }
            }
            if (entry.count) continue;
            const Node& node = nodes_[entry.first];
            Float4 sum = broadcast(0);
            for (int axis = 0; axis < 3; ++axis) {
                const Float4 gap =
                    maximum(maximum(node.low[axis] - high[axis], low[axis] - node.high[axis]), broadcast(0));
                sum += gap * gap;
            }
            const int pushed = top;
            for (int k = 0; k < 4; ++k) {
                if (sum[k] > bound) continue;
                int slot = top++;  // insertion sort: the nearest child ends on top of the stack
                for (; slot > pushed && stack[slot - 1].squared < sum[k]; --slot) stack[slot] = stack[slot - 1];
                stack[slot] = {sum[k], node.first[k], node.count[k]};
            }
        }
        return best;
    }

    Frame frame_;
    std::vector<Node> nodes_;
    std::vector<Triangle> triangles_;  // in the tree's order
    std::vector<uint32_t> faces_;      // their face indices
};

}  // namespace pcbench::mesh
