// A ray and the triangles it meets, in float64 and without cracks: a ray through an edge meets one of its triangles.
#pragma once
#include <cmath>
#include <cstddef>
#include <utility>

#include "mesh/triangle.h"

namespace pcbench::mesh {

// Woop, Benthin and Wald, "Watertight ray/triangle intersection", 2013: space is sheared so that the ray is the z axis.
// Both triangles at an edge then compute its side of the ray from the same bits, up to the sign.
struct Ray {
    Vec3 origin, direction;

    Ray(const Vec3& from, const Vec3& towards) : origin(from), direction(towards) {
        const double size[3] = {std::fabs(towards.x), std::fabs(towards.y), std::fabs(towards.z)};
        z_ = size[0] > size[1] ? (size[0] > size[2] ? 0 : 2) : (size[1] > size[2] ? 1 : 2);
        x_ = (z_ + 1) % 3, y_ = (x_ + 1) % 3;
        along_ = 1 / part(towards, z_);
        shear_x_ = part(towards, x_) * along_, shear_y_ = part(towards, y_) * along_;
    }

    // t of the point origin + t * direction on the triangle, either side of it; NaN where there is none.
    double meets(const Triangle& triangle) const {
        const Vec3 a = triangle.a - origin, b = triangle.b - origin, c = triangle.c - origin;
        const double az = part(a, z_), bz = part(b, z_), cz = part(c, z_);
        const double ax = part(a, x_) - shear_x_ * az, ay = part(a, y_) - shear_y_ * az;
        const double bx = part(b, x_) - shear_x_ * bz, by = part(b, y_) - shear_y_ * bz;
        const double cx = part(c, x_) - shear_x_ * cz, cy = part(c, y_) - shear_y_ * cz;
        const double u = cx * by - cy * bx, v = ax * cy - ay * cx, w = bx * ay - by * ax;
        if ((u < 0 || v < 0 || w < 0) && (u > 0 || v > 0 || w > 0)) return NAN;
        const double area = u + v + w;
        if (area == 0) return NAN;  // seen edge-on
        return (u * az + v * bz + w * cz) * along_ / area;
    }

private:
    static double part(const Vec3& v, int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

    int x_, y_, z_;
    double along_, shear_x_, shear_y_;
};

}  // namespace pcbench::mesh
