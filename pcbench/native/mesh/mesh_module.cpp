// Python bindings of the triangle tree.
#include "mesh/mesh_module.h"

#include <optional>
#include <utility>

#include "common/arrays.h"
#include "common/interruptible.h"
#include "mesh/mesh_index.h"

using pcbench::Interrupt;
using pcbench::interruptible;
using pcbench::mesh::MeshIndex;

namespace {

void init(MeshIndex* self, Points vertices, In<int64_t, nb::shape<-1, 3>> faces) {
    const size_t count = faces.shape(0);
    if (count == 0 || count >> 31) throw nb::value_error("MeshIndex: expected 1 to 2^31 - 1 faces");
    for (size_t i = 0; i < 3 * count; ++i)
        if (faces.data()[i] < 0 || static_cast<size_t>(faces.data()[i]) >= vertices.shape(0))
            throw nb::index_error("MeshIndex: expected faces with valid vertex indices");
    std::optional<MeshIndex> built;
    interruptible([&](Interrupt& interrupt) {
        built.emplace(vertices.data(), vertices.shape(0), faces.data(), count, interrupt);
    });
    new (self) MeshIndex(std::move(*built));
}

void query(const MeshIndex& self, Points points, Out<double, nb::shape<-1>> distances,
           Out<double, nb::shape<-1, 3>> closest, Out<int64_t, nb::shape<-1>> faces,
           Out<uint8_t, nb::shape<-1>> features) {
    const size_t count = points.shape(0);
    if (distances.shape(0) != count || closest.shape(0) != count || faces.shape(0) != count ||
        features.shape(0) != count)
        throw nb::value_error("MeshIndex: expected outputs with one row for each point");
    if (count >> 32) throw nb::value_error("MeshIndex: expected fewer than 2^32 points at once");
    interruptible([&](Interrupt& interrupt) {
        self.query(points.data(), count, distances.data(), closest.data(), faces.data(), features.data(), interrupt);
    });
}

void check_rays(size_t origins, size_t directions, size_t outputs) {
    if (origins != directions || origins != outputs)
        throw nb::value_error("MeshIndex: expected an origin, a direction and a row of each output for every ray");
}

void cast(const MeshIndex& self, Points origins, Points directions, double limit, Out<double, nb::shape<-1>> distances,
          Out<int64_t, nb::shape<-1>> faces) {
    check_rays(origins.shape(0), directions.shape(0), distances.shape(0));
    check_rays(origins.shape(0), directions.shape(0), faces.shape(0));
    interruptible([&](Interrupt& interrupt) {
        self.cast(origins.data(), directions.data(), origins.shape(0), limit, distances.data(), faces.data(),
                  interrupt);
    });
}

void blocked(const MeshIndex& self, Points origins, Points directions, double limit, Out<bool, nb::shape<-1>> blocked) {
    check_rays(origins.shape(0), directions.shape(0), blocked.shape(0));
    interruptible([&](Interrupt& interrupt) {
        self.blocked(origins.data(), directions.data(), origins.shape(0), limit, blocked.data(), interrupt);
    });
}

}  // namespace

void bind_mesh(nb::module_& m) {
    nb::class_<MeshIndex>(m, "MeshIndex", "A box tree over triangles. The caller checks that vertices are finite.")
        .def("__init__", &init, nb::arg("vertices"), nb::arg("faces"))
        .def("__len__", &MeshIndex::size)
        .def("query", &query, nb::arg("points"), nb::arg("distances").noconvert(), nb::arg("closest").noconvert(),
             nb::arg("faces").noconvert(), nb::arg("features").noconvert(),
             "Closest points on the mesh, written in place: distances (N,), closest (N, 3), faces (N,), and features "
             "(N,):\n"
             "0-2 for the corners of the face, 3-5 for its edges 01, 12, 20, 6 for its interior.")
        .def("cast", &cast, nb::arg("origins"), nb::arg("directions"), nb::arg("limit"),
             nb::arg("distances").noconvert(), nb::arg("faces").noconvert(),
             "First intersections of rays with the mesh, written in place: distances (N,) in lengths of the\n"
             "directions, infinity without an intersection before `limit`, and faces (N,), -1 without one.")
        .def("blocked", &blocked, nb::arg("origins"), nb::arg("directions"), nb::arg("limit"),
             nb::arg("blocked").noconvert(), "Whether rays intersect the mesh before `limit`, written in place (N,).");
}
