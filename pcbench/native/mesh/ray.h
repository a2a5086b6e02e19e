// Watertight ray-triangle intersection in float64: a ray through an edge intersects at least one of its two triangles.
#pragma once
#include <cmath>
#include <cstddef>
#include <utility>

#include "mesh/triangle.h"

namespace pcbench::mesh {

// Woop, Benthin and Wald, "Watertight ray/triangle intersection", 2013. Space is sheared so that the ray is the z axis.
// Both triangles at an edge then compute its side of the ray from the same bits, up to the sign.
struct Ray {
    Vec3 origin, direction;

    Ray(const Vec3& from, const Vec3& towards) : origin(from), direction(towards) {
        const double magnitude[3] = {std::fabs(towards.x), std::fabs(towards.y), std::fabs(towards.z)};
        z_ =
            magnitude[0] > magnitude[1] ? (magnitude[0] > magnitude[2] ? 0 : 2) : (magnitude[1] > magnitude[2] ? 1 : 2);
        x_ = (z_ + 1) % 3, y_ = (x_ + 1) % 3;
        shear_z_ = 1 / component(towards, z_);
        shear_x_ = component(towards, x_) * shear_z_, shear_y_ = component(towards, y_) * shear_z_;
    }

    // Parameter t of the intersection origin + t * direction, on either side of the triangle; NaN if there is none.
    double intersect(const Triangle& triangle) const {
        const Vec3 a = triangle.a - origin, b = triangle.b - origin, c = triangle.c - origin;
        const double az = component(a, z_), bz = component(b, z_), cz = component(c, z_);
        const double ax = component(a, x_) - shear_x_ * az, ay = component(a, y_) - shear_y_ * az;
        const double bx = component(b, x_) - shear_x_ * bz, by = component(b, y_) - shear_y_ * bz;
        const double cx = component(c, x_) - shear_x_ * cz, cy = component(c, y_) - shear_y_ * cz;
        const double u = cx * by - cy * bx, v = ax * cy - ay * cx, w = bx * ay - by * ax;
        if ((u < 0 || v < 0 || w < 0) && (u > 0 || v > 0 || w > 0)) return NAN;
        const double area = u + v + w;
        if (area == 0) return NAN;  // seen edge-on
        return (u * az + v * bz + w * cz) * shear_z_ / area;
    }

private:
    static double component(const Vec3& v, int axis) { return axis == 0 ? v.x : axis == 1 ? v.y : v.z; }

    int x_, y_, z_;
    double shear_z_, shear_x_, shear_y_;
};

}  // namespace pcbench::mesh
