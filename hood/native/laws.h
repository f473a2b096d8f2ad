// The laws of contact and friction, the compiled forms of hood/energies/laws.py, and those of membrane and bending, of
// hood/energies/membrane.py and bending.py. Every compiled pass takes them from here. Orders of operations are part of a law: bits depend on them.
#pragma once
#include <cmath>

#include "lanes.h"

namespace {

// ---- contact: w p^3 of a depth p > 0, and nothing of others ----------------------------------------------------------------

inline double contact_energy(double weight, double depth) { return weight * depth * depth * depth; }
inline double contact_force(double weight, double depth) { return 3.0 * weight * depth * depth; }
inline double contact_curvature(double weight, double depth) { return 6.0 * weight * depth; }
// Depth at which contact carries a force.
inline double contact_depth(double weight, double force) { return std::sqrt(force / (3.0 * weight)); }

// Force that takes contact from the depth where the Newton model leads to the one where the whole penalty balances that model.
inline double contact_push(double weight, double start, double end, double compliance) {
    const double cubic = 3.0 * weight;
    // The model's own force at the end, and the stiffness of everything else.
    const double force = cubic * start * (2.0 * end - start);
    double rest = 1.0 / compliance - 2.0 * cubic * start;
    if (rest < 0.1 / compliance) rest = 0.1 / compliance;
    double load = force + rest * end;
    if (load < 0.0) load = 0.0;
    // cubic q^2 + rest (q - end) = force for the depth q >= 0.
    const double balance = 2.0 * load / (rest + std::sqrt(rest * rest + 4.0 * cubic * load));
    return end > balance ? (end - balance) / compliance : 0.0;
}

// ---- friction: a force times f(y) of the slip's length y, see hood.energies.laws.mollified_norm -----------------------------

inline double mollified_norm(double y, double limit) { return y < limit ? y * y / limit * (1.0 - y / (3.0 * limit)) + limit / 3.0 : y; }
// f' / y, and the slope of the energy F f(y) by the slip, over y.
inline double slip_slope(double y, double limit) { return y < limit ? (2.0 - y / limit) / limit : 1.0 / y; }
inline double friction_slope(double force, double y, double limit) { return force * slip_slope(y, limit); }
// F f''. The solvers need f'' <= f' / y: the difference is what may make a matrix indefinite.
inline double friction_curvature(double force, double y, double limit) { return y < limit ? force * 2.0 * (1.0 - y / limit) / limit : 0.0; }

// ---- membrane: mu tr G^2 + lambda / 2 tr^2 G of the Green strain, eight faces at a time --------------------------------------

inline V8 isotropic_density(V8 mu, V8 lambda, V8 g00, V8 g01, V8 g11) {
    const V8 trace = g00 + g11, square = g00 * g00 + g11 * g11 + 2.0 * g01 * g01;
    return mu * square + 0.5 * lambda * trace * trace;
}

// ---- bending: of angles of hinges, eight at a time ---------------------------------------------------------------------------

constexpr double EPS = 2.220446049250313e-16, TINY = 2.2250738585072014e-308;
constexpr double DEGENERATE = (8.0 * EPS) * (8.0 * EPS);  // square of a sine, as in hood.mesh.geometry
constexpr double TURN = 6.283185307179586476925;

// Whether a triangle has an area, by the square of a cross product and that of the lengths.
inline I8 regular(V8 cross_sq, V8 product_sq) { return (cross_sq > DEGENERATE * product_sq) & (cross_sq > all(TINY / EPS)); }

inline V8 bend_of(V8 angle, V8 rest_angle) {
    const V8 bend = angle - rest_angle, zero = all(0.0);
    // Both angles are within a half turn, so at most one turn is off.
    return bend - (bend > 0.5 * TURN ? all(TURN) : bend < -0.5 * TURN ? all(-TURN) : zero);
}

}  // namespace
