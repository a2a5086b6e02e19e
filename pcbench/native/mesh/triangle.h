// Closest point on a triangle in float64, and the feature (corner, edge or interior) on which it lies.
#pragma once
#include <cmath>
#include <cstdint>

#include "common/vec3.h"

namespace pcbench::mesh {

inline bool lexicographically_less(const Vec3& a, const Vec3& b) {
    return a.x != b.x ? a.x < b.x : a.y != b.y ? a.y < b.y : a.z < b.z;
}

struct Triangle {
    Vec3 a, b, c;
};

// Corners 0-2 are a, b, c; edges 3-5 are ab, bc, ca; 6 is the interior.
enum Feature : uint8_t { kCorner = 0, kEdge = 3, kFace = 6 };

struct ClosestPoint {
    double squared_distance;
    Vec3 point;
    uint8_t feature;
};

// Updates `closest` with the closest point of the segment from corner i to corner j.
inline void closest_point_on_edge(const Vec3& p, const Vec3& first, const Vec3& second, int i, int j, int edge,
                                  ClosestPoint& closest) {
    // The edge has one direction for both of its triangles: they compute the same bits, so that ties stay ties.
    const bool swap = lexicographically_less(second, first);
    const Vec3 &a = swap ? second : first, &b = swap ? first : second;
    const Vec3 ab = b - a, ap = p - a;
    const double along = dot(ap, ab), length = dot(ab, ab);
    Vec3 offset, point;
    uint8_t feature;
    if (!(along > 0)) {
        offset = ap, point = a, feature = static_cast<uint8_t>(kCorner + (swap ? j : i));
    } else if (along >= length) {
        offset = p - b, point = b, feature = static_cast<uint8_t>(kCorner + (swap ? i : j));
    } else {
        const Vec3 part = (along / length) * ab;
        offset = ap - part, point = a + part, feature = static_cast<uint8_t>(kEdge + edge);
    }
    const double squared = dot(offset, offset);
    if (squared < closest.squared_distance) closest = {squared, point, feature};
}

// Ericson, Real-Time Collision Detection (2005), section 5.1.5, with barycentric coordinates from cross products, whose
// errors grow with the aspect ratio of the triangle and not with its square. A closest point outside the face lies on
// an edge that separates the face from the query's projection; only those edges are tested. A triangle without area
// consists of its three edges.
inline ClosestPoint closest_point_on_triangle(const Vec3& p, const Triangle& t) {
    const Vec3 ab = t.b - t.a, ac = t.c - t.a, ap = p - t.a;
    const Vec3 normal = cross(ab, ac);
    const double area = dot(normal, normal), squared_sides = dot(ab, ab) * dot(ac, ac);
    const double w = dot(cross(normal, ab), ap);  // barycentric coordinate of c, times area
    const double v = dot(cross(ac, normal), ap);  // barycentric coordinate of b, times area
    const double u = area - v - w;
    // Near an edge, rounding decides between edge and face. The nearer one is taken, and the edge on ties, so that a
    // query at a corner returns exactly that corner.
    const bool slender = !(area > 1e-6 * squared_sides);  // the angle at corner a is below 0.001 rad
    const double edge_tolerance = slender ? HUGE_VAL : 1e-6 * area;
    ClosestPoint closest{HUGE_VAL, t.a, kCorner};
    if (!(w > edge_tolerance)) closest_point_on_edge(p, t.a, t.b, 0, 1, 0, closest);
    if (!(u > edge_tolerance)) closest_point_on_edge(p, t.b, t.c, 1, 2, 1, closest);
    if (!(v > edge_tolerance)) closest_point_on_edge(p, t.c, t.a, 2, 0, 2, closest);
    const bool degenerate = !(area > 1e-28 * squared_sides);  // an angle of 1e-14 rad is rounding
    if (!degenerate && u > 0 && v > 0 && w > 0) {
        // Height above the plane, measured from one of its points. The normal of a slender triangle is inexact, so a
        // point near the query is used.
        const double height = dot(normal, slender ? p - closest.point : ap);
        const double squared = height / area * height;
        if (squared < closest.squared_distance) closest = {squared, p - (height / area) * normal, kFace};
    }
    return closest;
}

}  // namespace pcbench::mesh
