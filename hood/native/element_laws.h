// The laws of membrane and bending, the compiled forms of hood/energies/membrane.py and bending.py, of as many elements at a time as a register holds.
// Every compiled pass takes them from here. Orders of operations are part of a law: bits depend on them.
#pragma once
#include "lanes.h"

namespace {

// ---- membrane: Green strain, energy density [J/m^3], second Piola-Kirchhoff stress [Pa] --------------------------------------

struct Strain {
    VN g00, g01, g11;
};
struct Stress {
    VN s00, s01, s11;
};

// Strain (F^T F - 1) / 2 of the two columns of a deformation gradient F.
inline Strain green_strain(const VN (*f)[3]) {
    return {0.5 * (dot(f[0], f[0]) - 1.0), 0.5 * dot(f[0], f[1]), 0.5 * (dot(f[1], f[1]) - 1.0)};
}

// Isotropic cloth by its Lame parameters [Pa]: the density is mu tr G^2 + lambda / 2 tr^2 G.
struct Isotropic {
    VN mu, lambda;
};

inline VN density_of(const Isotropic& law, const Strain& g) {
    const VN trace = g.g00 + g.g11, square = g.g00 * g.g00 + g.g11 * g.g11 + 2.0 * g.g01 * g.g01, pressure = law.lambda * trace;
    return law.mu * square + 0.5 * pressure * trace;
}

// Stress 2 mu G + lambda tr G, times a factor.
inline Stress stress_of(const Isotropic& law, const Strain& g, VN factor) {
    const VN pressure = law.lambda * (g.g00 + g.g11), s00 = 2.0 * law.mu * g.g00 + pressure, s11 = 2.0 * law.mu * g.g11 + pressure;
    return {factor * s00, factor * 2.0 * law.mu * g.g01, factor * s11};
}

// Cloth with warp and weft by the roots of its stiffness [sqrt Pa], see hood.energies.membrane: the density is half the sum of the
// squares of first g00 + coupled g11, second g11 and turn 2 g01.
struct Weave {
    VN first, coupled, second, turn;
};

inline VN density_of(const Weave& law, const Strain& g) {
    const VN a = law.first * g.g00 + law.coupled * g.g11, b = law.second * g.g11, c = 2.0 * law.turn * g.g01;
    return 0.5 * (a * a + b * b + c * c);
}

// Stress of the weave, times a factor.
inline Stress stress_of(const Weave& law, const Strain& g, VN factor) {
    const VN a = law.first * g.g00 + law.coupled * g.g11, s11 = law.coupled * a + law.second * law.second * g.g11;
    return {factor * law.first * a, factor * 2.0 * law.turn * law.turn * g.g01, factor * s11};
}

// ---- bending: w / 2 of the square of a hinge's angle against that at rest ----------------------------------------------------

constexpr double EPS = 2.220446049250313e-16, TINY = 2.2250738585072014e-308;
constexpr double DEGENERATE = (8.0 * EPS) * (8.0 * EPS);  // square of a sine, as in hood.mesh.geometry
constexpr double TURN = 6.283185307179586476925;

// Whether a triangle has an area, by the square of a cross product and that of the lengths.
inline IN regular(VN cross_sq, VN product_sq) { return (cross_sq > DEGENERATE * product_sq) & (cross_sq > every(TINY / EPS)); }

// A hinge with its lengths times a scale: edge and arms from the first corner, normals edge x a and b x edge, angle [rad]. Where a
// face is degenerate the angle is 0, and squares are 1.
struct Hinge {
    VN edge[3], a[3], b[3], n1[3], n2[3], length, edge_sq, n1_sq, n2_sq, angle;
    IN regular;
};

// The hinge of the offsets [m] of its other corners from the first, times ``scale`` [1/m].
inline void hinge_of(const VN (*offset)[3], VN scale, Hinge& h) {
    for (int k = 0; k < 3; ++k) h.edge[k] = offset[0][k] * scale, h.a[k] = offset[1][k] * scale, h.b[k] = offset[2][k] * scale;
    cross(h.edge, h.a, h.n1);
    cross(h.b, h.edge, h.n2);
    const VN one = every(1.0), edge_sq = dot(h.edge, h.edge), n1_sq = dot(h.n1, h.n1), n2_sq = dot(h.n2, h.n2);
    h.regular = regular(n1_sq, edge_sq * dot(h.a, h.a)) & regular(n2_sq, edge_sq * dot(h.b, h.b));
    h.edge_sq = h.regular ? edge_sq : one;
    h.n1_sq = h.regular ? n1_sq : one;
    h.n2_sq = h.regular ? n2_sq : one;
    h.length = root(h.edge_sq);
    const VN sine = h.regular ? -h.length * dot(h.n1, h.b) : every(0.0);
    h.angle = angle_of(sine, h.regular ? dot(h.n1, h.n2) : one);
}

// Slopes of the angle at the four corners [1/m] for ``pull`` = -length times the scale, in proportion for others. Those at the
// opposite corners are along the normals; those at the ends of the edge follow from no net force and torque. 0 where degenerate.
inline void hinge_slopes(const Hinge& h, VN pull, VN (*slope)[3]) {
    const VN share_a = dot(h.edge, h.a) / h.edge_sq, share_b = dot(h.edge, h.b) / h.edge_sq;
    const VN along = h.regular ? pull : every(0.0), by_a = along / h.n1_sq, by_b = along / h.n2_sq;
    for (int k = 0; k < 3; ++k) {
        const VN at_a = by_a * h.n1[k], at_b = by_b * h.n2[k], at_end = -(share_a * at_a + share_b * at_b);
        slope[0][k] = -at_a - at_b - at_end, slope[1][k] = at_end, slope[2][k] = at_a, slope[3][k] = at_b;
    }
}

// How the slopes of that pull change along offsets [m] of the other corners from the first, times the same ``scale``.
inline void hinge_slopes_along(const Hinge& h, VN pull, VN scale, const VN (*slope)[3], const VN (*offset)[3], VN (*change)[3]) {
    VN edge[3], a[3], b[3], n1[3], n2[3], part[3];
    for (int k = 0; k < 3; ++k) edge[k] = offset[0][k] * scale, a[k] = offset[1][k] * scale, b[k] = offset[2][k] * scale;
    cross(edge, h.a, n1), cross(h.edge, a, part);
    for (int k = 0; k < 3; ++k) n1[k] += part[k];
    cross(b, h.edge, n2), cross(h.b, edge, part);
    for (int k = 0; k < 3; ++k) n2[k] += part[k];
    const VN zero = every(0.0), longer = dot(h.edge, edge) / h.edge_sq, share_a = dot(h.edge, h.a) / h.edge_sq, share_b = dot(h.edge, h.b) / h.edge_sq;
    const VN more_a = (dot(edge, h.a) + dot(h.edge, a)) / h.edge_sq - 2.0 * share_a * longer;
    const VN more_b = (dot(edge, h.b) + dot(h.edge, b)) / h.edge_sq - 2.0 * share_b * longer;
    const VN along = h.regular ? pull : zero, by_a = along / h.n1_sq, by_b = along / h.n2_sq;
    const VN grown_a = longer - 2.0 * dot(h.n1, n1) / h.n1_sq, grown_b = longer - 2.0 * dot(h.n2, n2) / h.n2_sq;
    for (int k = 0; k < 3; ++k) {
        const VN at_a = grown_a * slope[2][k] + by_a * n1[k], at_b = grown_b * slope[3][k] + by_b * n2[k];
        const VN at_end = -(more_a * slope[2][k] + share_a * at_a + more_b * slope[3][k] + share_b * at_b);
        change[0][k] = -at_a - at_b - at_end, change[1][k] = at_end, change[2][k] = at_a, change[3][k] = at_b;
    }
}

inline VN bend_of(VN angle, VN rest_angle) {
    const VN bend = angle - rest_angle, zero = every(0.0);
    // Both angles are within a half turn, so at most one turn is off.
    return bend - (bend > 0.5 * TURN ? every(TURN) : bend < -0.5 * TURN ? every(-TURN) : zero);
}

inline VN bending_energy(VN weight, VN bend) { return 0.5 * weight * bend * bend; }

}  // namespace
