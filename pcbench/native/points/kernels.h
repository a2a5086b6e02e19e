// The loops that exist once for each instruction set, and the choice between them.
#pragma once
#include "common/interrupt.h"
#include "points/tree.h"

namespace pcbench {

// Whether another point than a query's match has a squared distance below the match's plus `slack`.
struct Ties {
    double slack = 0.0;
    bool* flags = nullptr;  // null: nobody asks
};

struct Kernels {
    const char* name;
    bool (*arrange)(const double* points, size_t count, double limit, Leaf* leaves, Node* nodes, Interrupt&);
    void (*bound)(Tree&);
    void (*nearest)(const Tree&, const Leaf* queries, size_t leaf_count, const int64_t* hints, bool own,
                    double* distances, int64_t* indices, Ties, Interrupt&);
    void (*knearest)(const Tree&, const Leaf* queries, size_t leaf_count, size_t k, double* distances, int64_t* indices,
                     Interrupt&);
    // Both write the number of points found for query row i to offsets[i + 1] when rows is null; else the rows
    // themselves, from rows[offsets[i]] on, in no particular order.
    void (*in_balls)(const Tree&, const Leaf* centres, size_t leaf_count, double radius, int64_t* offsets,
                     int64_t* rows, Interrupt&);
    void (*in_cylinders)(const Tree&, const Leaf* origins, size_t leaf_count, const double* axes, double radius,
                         double half_length, int64_t* offsets, int64_t* rows, Interrupt&);
    // Queries are points of the tree, rows their numbers, null for all in order; scratch: for each thread, of the size
    // plane_scratch_bytes(k). distances, indices: to the nearest other point.
    void (*planes)(const Tree&, const Leaf* queries, size_t leaf_count, const int64_t* rows, size_t k, double* normals,
                   double* variation, double* distances, int64_t* indices, double* const* scratch, Interrupt&);
    size_t (*plane_scratch_bytes)(size_t k);
};

namespace baseline {
extern const Kernels kernels;
}
#ifdef PCB_X86
namespace avx2 {
extern const Kernels kernels;
}
namespace avx512 {
extern const Kernels kernels;
}
#endif

// The widest this machine has, or the one PCBENCH_ISA names; throws std::runtime_error when that one cannot run.
const Kernels& kernels();

}  // namespace pcbench
