// Vectors of three doubles.
#pragma once

namespace pcbench {

struct Vec3 {
    double x, y, z;
};

// Read and write a row of an array (N, 3).
inline Vec3 vec3(const double* row) { return {row[0], row[1], row[2]}; }
inline void write(const Vec3& v, double* row) { row[0] = v.x, row[1] = v.y, row[2] = v.z; }

inline Vec3 operator+(const Vec3& a, const Vec3& b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec3 operator-(const Vec3& a, const Vec3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec3 operator*(double s, const Vec3& a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(const Vec3& a, const Vec3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec3 cross(const Vec3& a, const Vec3& b) {
    return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

}  // namespace pcbench
