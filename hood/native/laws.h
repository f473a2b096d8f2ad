// The laws of contact and friction, the compiled forms of hood/energies/laws.py. Every compiled pass takes them from here. Those of
// membrane and bending are in element_laws.h. Orders of operations are part of a law: bits depend on them.
#pragma once
#include <cmath>

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

}  // namespace
