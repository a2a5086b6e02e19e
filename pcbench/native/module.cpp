// The compiled core: loops over points that numpy cannot fuse. No Python objects inside the loops, the GIL released.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include "mesh_module.h"
#include "normals.h"

namespace nb = nanobind;

template <typename T, typename... Shape>
using In = nb::ndarray<const T, nb::c_contig, nb::device::cpu, Shape...>;
template <typename T, typename... Shape>
using Out = nb::ndarray<T, nb::c_contig, nb::device::cpu, Shape...>;

NB_MODULE(_core, m) {
    m.doc() = "Compiled kernels of pcbench; call them through the modules that own them.";

    m.def(
        "plane_fits",
        [](In<double, nb::shape<-1, 3>> points, In<int64_t, nb::ndim<2>> neighbors,
           Out<double, nb::shape<-1, 3>> normals, Out<double, nb::shape<-1>> variation) {
            const size_t rows = neighbors.shape(0), k = neighbors.shape(1);
            if (normals.shape(0) != rows || variation.shape(0) != rows)
                throw nb::value_error("plane_fits: normals and variation need one row for each row of neighbors");
            bool in_range;
            {
                nb::gil_scoped_release release;
                in_range = pcbench::plane_fits(points.data(), points.shape(0), neighbors.data(), rows, k,
                                               normals.data(), variation.data());
            }
            if (!in_range) throw nb::index_error("plane_fits: a neighbour index lies outside points");
        },
        nb::arg("points"), nb::arg("neighbors"), nb::arg("normals").noconvert(), nb::arg("variation").noconvert(),
        "Fit a plane to each row of neighbours: unit normals (M, 3) and surface variation (M,) are written in place.");
    bind_mesh(m);
}
