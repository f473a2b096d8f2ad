// What presses pairs of features of cloth onto each other in a step: see hood/energies/self_contact.py.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "vector.h"

extern "C" {

// Pairs near each other at the start of a step: corners (N, 4), 1 for two edges, weights of the corners in the gap (N, 4), then the
// direction of the gap (N, 3), force of the barrier [N] and reach [m]. Of vertices: mass over dt^2 (V) [N/m], where they would fly
// to (V, 3) [m], forces of the cloth around with those of the pairs (V, 3) [N] or null, 1 where something behind holds them.
struct LayerPressing {
    int64_t count, num_vertices;
    const int64_t *corners, *edges;
    const double *weights, *normal, *force, *reach;
    const double *inertia, *there, *pull;
    const uint8_t* backed;
};
}

namespace {

// Loads of all pairs at vertices: their sum, and how they are spread over directions (upper triangles).
struct LayerLoads {
    std::vector<double> net, spread;

    explicit LayerLoads(const LayerPressing& s) : net(3 * s.num_vertices), spread(6 * s.num_vertices) {
        for (int64_t i = 0; i < s.count; ++i)
            for (int c = 0; c < 4; ++c) {
                const int64_t v = s.corners[4 * i + c];
                const double load = s.weights[4 * i + c] * s.force[i], *n = s.normal + 3 * i;
                int place = 0;
                for (int a = 0; a < 3; ++a) {
                    net[3 * v + a] += load * n[a];
                    for (int b = a; b < 3; ++b) spread[6 * v + place++] += std::fabs(load) * n[a] * n[b];
                }
            }
    }

    // Along a direction, and against it; exact where all pairs push along it.
    void along(int64_t v, Vec n, double* ahead, double* behind) const {
        const double *t = spread.data() + 6 * v, one = dot(at(net.data(), v), n);
        const double both = t[0] * n.x * n.x + t[3] * n.y * n.y + t[5] * n.z * n.z + 2.0 * (t[1] * n.x * n.y + t[2] * n.x * n.z + t[4] * n.y * n.z);
        *ahead = std::max(0.5 * (both + one), 0.0), *behind = std::max(0.5 * (both - one), 0.0);
    }
};

// What one side of a pair can bring [N]: its share of what its vertices' mass and the cloth behind them press on with.
inline double side_brings(const LayerPressing& s, const LayerLoads& loads, int64_t i, int first, int last, double sign) {
    const Vec outward = sign * at(s.normal, i);
    double missing = s.reach[i], sum = 0.0;
    for (int c = 0; c < 4; ++c) missing -= s.weights[4 * i + c] * dot(at(s.there, s.corners[4 * i + c]), at(s.normal, i));
    for (int c = first; c < last; ++c) {
        const int64_t v = s.corners[4 * i + c];
        const double part = std::fabs(s.weights[4 * i + c]) * s.force[i];
        if (!(part > 0.0)) continue;
        if (s.backed[v]) return std::numeric_limits<double>::infinity();
        double ahead, behind;
        loads.along(v, outward, &ahead, &behind);
        if (s.pull) behind -= dot(at(s.pull, v) - at(loads.net.data(), v), outward);
        sum += part / std::max(ahead, part) * (s.inertia[v] * std::max(missing, 0.0) + std::max(behind, 0.0));
    }
    return sum;
}

void layer_pressing(const LayerPressing& s, double* pressing) {
    const LayerLoads loads(s);
    for (int64_t i = 0; i < s.count; ++i) {
        const int split = s.edges[i] ? 2 : 1;
        pressing[i] = std::min(side_brings(s, loads, i, 0, split, 1.0), side_brings(s, loads, i, split, 4, -1.0));
    }
}

}  // namespace
