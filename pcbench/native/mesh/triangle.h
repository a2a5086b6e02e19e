// The point of a triangle nearest to a query, in float64, and the feature it lies on.
#pragma once
#include <cmath>
#include <cstdint>

#include "common/vec3.h"

namespace pcbench::mesh {

inline bool before(const Vec3& a, const Vec3& b) { return a.x != b.x ? a.x < b.x : a.y != b.y ? a.y < b.y : a.z < b.z; }

struct Triangle {
    Vec3 a, b, c;
};

// Corners 0-2 are a, b, c; edges 3-5 are ab, bc, ca; 6 is the inside of the face.
enum Feature : uint8_t { kCorner = 0, kEdge = 3, kFace = 6 };

struct Nearest {
    double squared;  // distance
    Vec3 closest;
    uint8_t feature;
};

// The nearest point of the segment from corner i to corner j, kept if it is nearer than what is there.
inline void nearest_on_edge(const Vec3& p, const Vec3& first, const Vec3& second, int i, int j, int edge,
                            Nearest& nearest) {
    // Always walked from the same end: both triangles at an edge then find the same bits, and ties stay ties.
    const bool swap = before(second, first);
    const Vec3 &a = swap ? second : first, &b = swap ? first : second;
    const Vec3 ab = b - a, ap = p - a;
    const double along = dot(ap, ab), length = dot(ab, ab);
    Vec3 offset, closest;
    uint8_t feature;
    if (!(along > 0)) {
        offset = ap, closest = a, feature = static_cast<uint8_t>(kCorner + (swap ? j : i));
    } else if (along >= length) {
        offset = p - b, closest = b, feature = static_cast<uint8_t>(kCorner + (swap ? i : j));
    } else {
        const Vec3 part = (along / length) * ab;
        offset = ap - part, closest = a + part, feature = static_cast<uint8_t>(kEdge + edge);
    }
    const double squared = dot(offset, offset);
    if (squared < nearest.squared) nearest = {squared, closest, feature};
}

// Ericson, Real-Time Collision Detection (2005), 5.1.5, with barycentric coordinates from cross products: their errors
// grow with the slenderness of the triangle, not with its square. A closest point outside the face lies on an edge that
// the query's projection is beyond, so only those are looked at; a triangle without area is its three edges.
inline Nearest nearest_on_triangle(const Vec3& p, const Triangle& t) {
    const Vec3 ab = t.b - t.a, ac = t.c - t.a, ap = p - t.a;
    const Vec3 normal = cross(ab, ac);
    const double area = dot(normal, normal), sides = dot(ab, ab) * dot(ac, ac);
    const double w = dot(cross(normal, ab), ap);  // of c, times area
    const double v = dot(cross(ac, normal), ap);  // of b, times area
    const double u = area - v - w;
    // Close to an edge rounding decides between it and the face: the nearer of the two, the edge of equals, so that a
    // query on a corner finds just that.
    const bool slender = !(area > 1e-6 * sides);  // an angle at a below a thousandth
    const double close = slender ? HUGE_VAL : 1e-6 * area;
    Nearest nearest{HUGE_VAL, t.a, kCorner};
    if (!(w > close)) nearest_on_edge(p, t.a, t.b, 0, 1, 0, nearest);
    if (!(u > close)) nearest_on_edge(p, t.b, t.c, 1, 2, 1, nearest);
    if (!(v > close)) nearest_on_edge(p, t.c, t.a, 2, 0, 2, nearest);
    const bool flat = !(area > 1e-28 * sides);  // an angle of 1e-14 is rounding
    if (!flat && u > 0 && v > 0 && w > 0) {
        // The height over the plane, measured from a point of it: a slender triangle's normal is not exact, so from one
        // close by.
        const double height = dot(normal, slender ? p - nearest.closest : ap);
        const double squared = height / area * height;
        if (squared < nearest.squared) nearest = {squared, p - (height / area) * normal, kFace};
    }
    return nearest;
}

}  // namespace pcbench::mesh
