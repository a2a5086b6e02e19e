// Closest points on triangles, and ray casting.
#include "mesh/mesh_index.h"

#include "golden.h"

namespace {

bool no_interrupt() { return false; }

}  // namespace

void golden::mesh() {
    constexpr int kSide = 50;
    constexpr size_t kQueries = 4000;
    Random random(3);
    std::vector<double> vertices;
    for (int y = 0; y < kSide; ++y)
        for (int x = 0; x < kSide; ++x) vertices.insert(vertices.end(), {x * 1.0, y * 1.0, random.uniform(0, 2)});
    std::vector<int64_t> faces;
    for (int64_t y = 0; y + 1 < kSide; ++y)
        for (int64_t x = 0; x + 1 < kSide; ++x) {
            const int64_t corner = y * kSide + x;
            faces.insert(faces.end(), {corner, corner + 1, corner + kSide});
            faces.insert(faces.end(), {corner + 1, corner + kSide + 1, corner + kSide});
        }
    pcbench::Interrupt interrupt(no_interrupt);
    const pcbench::mesh::MeshIndex index(vertices.data(), vertices.size() / 3, faces.data(), faces.size() / 3,
                                         interrupt);
    std::vector<double> points, directions;
    for (size_t i = 0; i < kQueries; ++i) {
        points.insert(points.end(), {random.uniform(-2, 54), random.uniform(-2, 54), random.uniform(-1, 8)});
        directions.insert(directions.end(), {random.uniform(-1, 2), random.uniform(-1, 2), random.uniform(-2, 3)});
    }
    std::vector<double> distances(kQueries), closest(3 * kQueries);
    std::vector<int64_t> hit_faces(kQueries);
    std::vector<uint8_t> features(kQueries);
    index.query(points.data(), kQueries, distances.data(), closest.data(), hit_faces.data(), features.data(),
                interrupt);
    Hash("mesh_distances").add(distances).add(closest).add(hit_faces).add(features);
    index.cast(points.data(), directions.data(), kQueries, 1e6, distances.data(), hit_faces.data(), interrupt);
    Hash("mesh_rays").add(distances).add(hit_faces);
}
