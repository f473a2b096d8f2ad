// Cloth near cloth as a solver sees it: calls into layers.cpp, which is a library of its own, and what its last model came to.
#pragma once
#include <cstdint>

namespace {

struct LayerView {
    void* layers;
    double (*limit)(void* layers, const double* from, const double* to, double left);
    void (*ease)(void* layers, const double* from, double* to, double left);
    double (*energy)(void* layers, const double* pos);
    int64_t (*model)(void* layers, const double* pos);
    double *here, *there;  // (3 V) positions in the cloth's own numbering: room for the solver
    // Of the last model: pairs in reach, the solver's numbers of their corners (N, 4), 0 for those that do not move, their rows
    // (N, 4, 4) in both precisions, 0 for those; gradient (3 V) and upper triangles of the diagonal blocks (6 V).
    int64_t num_contacts;
    const int32_t* rows;
    const double* normals;
    const float* normals_single;
    const double *gradient, *own;
};

}  // namespace
