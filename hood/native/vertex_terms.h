// Contact, friction and drag as they act on one vertex, or at one point of the cloth.
#pragma once
#include <cmath>
#include <cstdint>

#include "laws.h"

extern "C" {

// A collision term as planes, or a friction term; rows of original vertices, zero where nothing acts.
struct Wall {
    const double *point, *normal, *reach;  // (V, 3), (V, 3), (V)
    double weight;
    const double* share;  // (V) factors of the weight; none for vertices
};
struct Grip {
    const double *force, *normal, *anchor, *limit;  // (V), (V, 3), (V, 3), (V)
};
// Drag of the air; rows of points.
struct Drag {
    const double *normal, *target, *across, *along;  // (N, 3), (N, 3), (N), (N)
};
}

namespace {

inline double dot3(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline double weight_of(const Wall& wall, int64_t v) { return wall.share ? wall.weight * wall.share[v] : wall.weight; }

inline double depth_of(const Wall& wall, int64_t v, const double* pos) {
    const double *point = wall.point + 3 * v, *normal = wall.normal + 3 * v;
    const double gap[3] = {pos[0] - point[0], pos[1] - point[1], pos[2] - point[2]};
    return wall.reach[v] - dot3(gap, normal);
}

inline double wall_energy(const Wall& wall, int64_t v, const double* pos) {
    const double depth = depth_of(wall, v, pos);
    // Not-a-number is no depth to leave out.
    return depth <= 0.0 ? 0.0 : contact_energy(weight_of(wall, v), depth);
}

// Tangential slip; returns its length.
inline double slip_of(const Grip& grip, int64_t v, const double* pos, double* slip) {
    const double *anchor = grip.anchor + 3 * v, *normal = grip.normal + 3 * v;
    for (int k = 0; k < 3; ++k) slip[k] = pos[k] - anchor[k];
    const double along = dot3(slip, normal);
    for (int k = 0; k < 3; ++k) slip[k] -= along * normal[k];
    return std::sqrt(dot3(slip, slip));
}

inline double grip_energy(const Grip& grip, int64_t v, const double* pos) {
    if (!(grip.force[v] > 0.0)) return 0.0;
    double slip[3];
    return grip.force[v] * mollified_norm(slip_of(grip, v, pos, slip), grip.limit[v]);
}

// Slip against the air in the plane of the normal, its length, and the slip along the normal.
inline double drift_of(const Drag& drag, int64_t v, const double* pos, double* slip, double* across) {
    const double *target = drag.target + 3 * v, *normal = drag.normal + 3 * v;
    for (int k = 0; k < 3; ++k) slip[k] = pos[k] - target[k];
    *across = dot3(slip, normal);
    for (int k = 0; k < 3; ++k) slip[k] -= *across * normal[k];
    return std::sqrt(dot3(slip, slip));
}

inline double drag_energy(const Drag& drag, int64_t v, const double* pos) {
    double slip[3], across;
    const double size = drift_of(drag, v, pos, slip, &across);
    return (drag.across[v] * std::fabs(across) * across * across + drag.along[v] * size * size * size) / 3.0;
}

// Force along the slip, of length ``size``, in units of it.
inline double slope_of(const Grip& grip, int64_t v, double size) {
    return friction_slope(grip.force[v], size, grip.limit[v]);
}

}  // namespace
