// Which depths of a map another map confirms: forward-backward reprojection (Schonberger et al. 2016, section 4.3).
#pragma once
#include <cmath>
#include <cstdint>
#include <limits>

#include "common/interrupt.h"

namespace pcbench::mvs {

constexpr double kMinSeeingConfidence = 0.5;  // a less confident depth behind a point does not contradict it
// Between a plane's depth half a pixel off its centre and at it; steeper normals are unreliable.
constexpr double kMaxDepthRatio = 1.05;
constexpr int64_t kConfirmChunk = 4096;  // pixels between two looks for Ctrl-C

// The depth map of a pinhole camera.
struct ConfirmMap {
    const float *depth, *normal, *confidence;
    int64_t height, width;
};

// From pixels of one camera with depths to homogeneous pixels of another: depth * linear (u, v, 1) + shift, (3, 4).
struct Warp {
    const double* rows;

    // Pixel coordinates and depth; not finite or not meaningful behind the other camera.
    void apply(double u, double v, double depth, double& x, double& y, double& z) const {
        double out[3];
        for (int r = 0; r < 3; ++r) {
            const double* m = rows + 4 * r;
            out[r] = depth * (m[0] * u + m[1] * v + m[2]) + m[3];
        }
        x = out[0] / out[2], y = out[1] / out[2], z = out[2];
    }
};

struct ConfirmCriteria {
    double confidence;  // minimum of the other map's depths
    double pixels;      // maximum forward-backward reprojection error
    double depth;       // maximum relative difference of the depths
    double min_cosine;  // of the angle between the normals
};

struct Confirmations {
    ConfirmMap map, other;
    Warp to_other, back;
    const double* pinhole;  // fx, fy, cx, cy of the other camera
    const double* turn;     // (3, 3), from the other camera's frame to this one's
    ConfirmCriteria criteria;

    // Depth of the other map's plane through a pixel at coordinates (u, v) in it.
    double depth_on_plane(int64_t row, int64_t column, double u, double v) const {
        const int64_t at = row * other.width + column;
        const float* n = other.normal + 3 * at;
        const double a = n[0], b = n[1], c = n[2], depth = other.depth[at];
        const double fx = pinhole[0], fy = pinhole[1], cx = pinhole[2], cy = pinhole[3];
        const double centre =
            a * ((static_cast<double>(column) + 0.5 - cx) / fx) + b * ((static_cast<double>(row) + 0.5 - cy) / fy) + c;
        const double slope = centre / (a * ((u - cx) / fx) + b * ((v - cy) / fy) + c);
        return slope < kMaxDepthRatio && slope > 1.0 / kMaxDepthRatio ? depth * slope : depth;
    }

    // The depth of the other map's surface at a pixel of the map, in the map's camera, NaN if it does not confirm the
    // map's depth; and whether the other image sees through it, to a surface behind it.
    double confirm(int64_t row, int64_t column, bool& sees_through) const {
        constexpr double kNone = std::numeric_limits<double>::quiet_NaN();
        sees_through = false;
        const int64_t pixel = row * map.width + column;
        const double u = static_cast<double>(column) + 0.5, v = static_cast<double>(row) + 0.5;
        double x, y, z;
        to_other.apply(u, v, map.depth[pixel], x, y, z);
        if (!(z > 0 && x >= 0 && x < static_cast<double>(other.width) && y >= 0 &&
              y < static_cast<double>(other.height)))
            return kNone;
        const int64_t other_row = static_cast<int64_t>(y), other_column = static_cast<int64_t>(x);
        const int64_t at = other_row * other.width + other_column;
        if (!(other.depth[at] > 0 && other.confidence[at] >= criteria.confidence)) return kNone;
        const double depth = depth_on_plane(other_row, other_column, x, y), beyond = depth - z;
        if (!(std::abs(beyond) <= criteria.depth * z)) {
            sees_through = beyond > 0 && other.confidence[at] >= kMinSeeingConfidence;
            return kNone;
        }
        double back_u, back_v, back_z;
        back.apply(x, y, depth, back_u, back_v, back_z);
        if (!(back_z > 0 && std::hypot(back_u - u, back_v - v) <= criteria.pixels)) return kNone;
        const float *n = map.normal + 3 * pixel, *m = other.normal + 3 * at;
        double cosine = 0;
        for (int r = 0; r < 3; ++r)
            cosine += n[r] * (turn[3 * r] * m[0] + turn[3 * r + 1] * m[1] + turn[3 * r + 2] * m[2]);
        return cosine >= criteria.min_cosine ? back_z : kNone;
    }

    // Writes the results of `count` pixels; false if Ctrl-C stopped it.
    bool run(const int64_t* rows, const int64_t* columns, int64_t count, double* depths, bool* sees_through,
             Interrupt& interrupt) const {
        const int64_t chunks = (count + kConfirmChunk - 1) / kConfirmChunk;
#pragma omp parallel for schedule(dynamic) if (chunks > 1)
        for (int64_t chunk = 0; chunk < chunks; ++chunk) {
            if (interrupt.requested()) continue;
            const int64_t end = chunk + 1 < chunks ? (chunk + 1) * kConfirmChunk : count;
            for (int64_t i = chunk * kConfirmChunk; i < end; ++i)
                depths[i] = confirm(rows[i], columns[i], sees_through[i]);
        }
        return !interrupt.stopped();
    }
};

}  // namespace pcbench::mvs
