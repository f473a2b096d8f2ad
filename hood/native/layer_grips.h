// Friction between layers of cloth, found at the start of a step: see hood/energies/self_contact.py.
#pragma once
#include <cmath>
#include <cstdint>
#include <cstring>

#include "vertex_terms.h"

extern "C" {

// Pairs of features that grip each other; vertices are numbered as the solver does.
struct LayerGrips {
    int64_t count;
    const int32_t* corners;                           // (N, 4)
    const double *weights, *normal, *force, *limit;   // (N, 4), (N, 3), (N), (N)
    double* model;                                    // (N, 5) heading of the slip, force by slip across it, and what is less along it
    double *gradient, *own, *own_indefinite_part;               // (V, 3), (V, 6), (V, 6) of the last model, by vertex
};
}

namespace {

// Tangential motion of the nearest points relative to each other at positions (V, 4); returns its length.
template <class T> inline double layer_slip(const LayerGrips& g, int64_t i, const T* pos, double* slip) {
    for (int k = 0; k < 3; ++k) slip[k] = 0.0;
    for (int c = 0; c < 4; ++c)
        for (int k = 0; k < 3; ++k) slip[k] += g.weights[4 * i + c] * (double)pos[4 * (int64_t)g.corners[4 * i + c] + k];
    const double* normal = g.normal + 3 * i;
    const double along = dot3(slip, normal);
    for (int k = 0; k < 3; ++k) slip[k] -= along * normal[k];
    return std::sqrt(dot3(slip, slip));
}

double layer_grip_energy(const LayerGrips& g, const double* pos) {
    double sum = 0.0, slip[3];
    for (int64_t i = 0; i < g.count; ++i) sum += g.force[i] * mollified_norm(layer_slip(g, i, pos, slip), g.limit[i]);
    return sum;
}

inline void add_symmetric(double* upper, double factor, const double* n) {
    int place = 0;
    for (int a = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b) upper[place++] += factor * n[a] * n[b];
}

// Forces and curvature at positions (V, 4), by pair and by vertex.
void model_layer_grips(const LayerGrips& g, int64_t num_vertices, const double* pos) {
    std::memset(g.gradient, 0, sizeof(double) * 3 * num_vertices);
    std::memset(g.own, 0, sizeof(double) * 6 * num_vertices);
    std::memset(g.own_indefinite_part, 0, sizeof(double) * 6 * num_vertices);
    for (int64_t i = 0; i < g.count; ++i) {
        double slip[3], block[6] = {}, less[6] = {}, *model = g.model + 5 * i;
        const double size = layer_slip(g, i, pos, slip), force = g.force[i], limit = g.limit[i];
        const double slope = friction_slope(force, size, limit);
        const double along = friction_curvature(force, size, limit);
        for (int k = 0; k < 3; ++k) model[k] = size > 0.0 ? slip[k] / size : 0.0;
        model[3] = slope, model[4] = size > 0.0 ? along - slope : 0.0;
        block[0] = block[3] = block[5] = slope;
        add_symmetric(block, -slope, g.normal + 3 * i);
        add_symmetric(less, model[4], model);
        for (int c = 0; c < 4; ++c) {
            const int64_t v = g.corners[4 * i + c];
            const double weight = g.weights[4 * i + c], square = weight * weight;
            for (int k = 0; k < 3; ++k) g.gradient[3 * v + k] += weight * slope * slip[k];
            for (int k = 0; k < 6; ++k) g.own[6 * v + k] += square * block[k], g.own_indefinite_part[6 * v + k] += square * less[k];
        }
    }
}

// Adds what pairs bring beside the diagonal blocks, with a share of the indefinite part, to q = H p: all that they bring, less those blocks.
// Vertices from num_rows on do not move; the others have a slot in p and q.
template <class T> void couple_layer_grips(const LayerGrips& g, int64_t num_rows, const int32_t* slot, double indefinite_share, const T* p, T* q) {
    for (int64_t i = 0; i < g.count; ++i) {
        const double *model = g.model + 5 * i, *normal = g.normal + 3 * i, *weights = g.weights + 4 * i;
        const int32_t* corners = g.corners + 4 * i;
        double slip[3] = {0.0, 0.0, 0.0};
        for (int c = 0; c < 4; ++c)
            for (int k = 0; k < 3 && corners[c] < num_rows; ++k) slip[k] += weights[c] * (double)p[4 * (int64_t)slot[corners[c]] + k];
        const double across = model[3] * dot3(slip, normal), along = indefinite_share * model[4] * dot3(slip, model);
        const double push[3] = {model[3] * slip[0] - across * normal[0] + along * model[0],
                                model[3] * slip[1] - across * normal[1] + along * model[1],
                                model[3] * slip[2] - across * normal[2] + along * model[2]};
        for (int c = 0; c < 4; ++c)
            for (int k = 0; k < 3 && corners[c] < num_rows; ++k) q[4 * (int64_t)slot[corners[c]] + k] += (T)(weights[c] * push[k]);
    }
    constexpr int PLACE[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};
    for (int64_t row = 0; row < num_rows; ++row) {
        const double *own = g.own + 6 * row, *less = g.own_indefinite_part + 6 * row;
        if (own[0] == 0.0 && own[3] == 0.0 && own[5] == 0.0) continue;
        for (int a = 0; a < 3; ++a) {
            double push = 0.0;
            for (int b = 0; b < 3; ++b) push += (own[PLACE[a][b]] + indefinite_share * less[PLACE[a][b]]) * (double)p[4 * (int64_t)slot[row] + b];
            q[4 * (int64_t)slot[row] + a] -= (T)push;
        }
    }
}

}  // namespace
