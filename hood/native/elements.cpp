// Energies of membrane and bending with their gradients, and edge strain: one pass over the elements of a cloth, in float64.
//
// Elements are taken in their order and added up in it, so that a result is the same in every run.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "vector.h"

namespace {

constexpr double EPS = 2.220446049250313e-16, TINY = 2.2250738585072014e-308;
constexpr double DEGENERATE = (8.0 * EPS) * (8.0 * EPS);  // square of a sine, as in hood.mesh.geometry
constexpr double TURN = 6.283185307179586476925;

inline void add(double* p, int64_t i, Vec a) { p[3 * i] += a.x, p[3 * i + 1] += a.y, p[3 * i + 2] += a.z; }
inline double largest(Vec a) { return std::max(std::fabs(a.x), std::max(std::fabs(a.y), std::fabs(a.z))); }

inline bool regular(double cross_sq, double product_sq) { return cross_sq > DEGENERATE * product_sq && cross_sq > TINY / EPS; }

}  // namespace

extern "C" {

struct Faces {
    int64_t count;
    const int64_t *corners, *scene;             // (F, 3), (F)
    const double *inverse, *weight, *mu, *lambda;  // (F, 4) 1/m, (F) m^3, Pa, Pa
};

struct Hinges {
    int64_t count, current_length;     // 1: the code's form, with the edge's length now and about flat
    const int64_t *corners, *scene;    // (H, 4), (H)
    const double *weight, *rest_angle; // (H) J, or J/m^2 with the current length; rad
};

// Adds the membrane's energies [J] to those of the scenes, and its gradient (V, 3) [N] if there is room for it.
void elements_faces(const Faces* faces, const double* pos, double* energy, double* gradient) {
    for (int64_t i = 0; i < faces->count; ++i) {
        const int64_t* c = faces->corners + 3 * i;
        const Vec x = at(pos, c[0]), d1 = at(pos, c[1]) - x, d2 = at(pos, c[2]) - x;
        const double* m = faces->inverse + 4 * i;
        const Vec f0 = m[0] * d1 + m[2] * d2, f1 = m[1] * d1 + m[3] * d2;
        const double g00 = 0.5 * (dot(f0, f0) - 1.0), g01 = 0.5 * dot(f0, f1), g11 = 0.5 * (dot(f1, f1) - 1.0);
        const double trace = g00 + g11, square = g00 * g00 + g11 * g11 + 2.0 * g01 * g01;
        const double weight = faces->weight[i], mu = faces->mu[i], lambda = faces->lambda[i];
        energy[faces->scene[i]] += weight * (mu * square + 0.5 * lambda * trace * trace);
        if (!gradient) continue;
        // First Piola-Kirchhoff stress F S, S = 2 mu G + lambda tr G, pulled back to the two edges.
        const double s00 = 2.0 * mu * g00 + lambda * trace, s01 = 2.0 * mu * g01, s11 = 2.0 * mu * g11 + lambda * trace;
        const Vec p0 = weight * (s00 * f0 + s01 * f1), p1 = weight * (s01 * f0 + s11 * f1);
        const Vec by1 = m[0] * p0 + m[1] * p1, by2 = m[2] * p0 + m[3] * p1;
        add(gradient, c[1], by1), add(gradient, c[2], by2), add(gradient, c[0], -(by1 + by2));
    }
}

// The same for bending; hinges with a degenerate face have the angle 0 and no force.
void elements_hinges(const Hinges* hinges, const double* pos, double* energy, double* gradient) {
    for (int64_t i = 0; i < hinges->count; ++i) {
        const int64_t* c = hinges->corners + 4 * i;
        const Vec x = at(pos, c[0]), e = at(pos, c[1]) - x, a = at(pos, c[2]) - x, b = at(pos, c[3]) - x;
        const double size = std::max(std::max(largest(e), std::max(largest(a), largest(b))), TINY), scale = 1.0 / size;
        const Vec edge = scale * e, arm_a = scale * a, arm_b = scale * b, n1 = cross(edge, arm_a), n2 = cross(arm_b, edge);
        const double edge_sq = dot(edge, edge), n1_sq = dot(n1, n1), n2_sq = dot(n2, n2);
        const bool sound = regular(n1_sq, edge_sq * dot(arm_a, arm_a)) && regular(n2_sq, edge_sq * dot(arm_b, arm_b));
        const double length = std::sqrt(edge_sq), angle = sound ? std::atan2(-length * dot(n1, arm_b), dot(n1, n2)) : 0.0;
        const double factor = hinges->weight[i] * (hinges->current_length ? dot(e, e) : 1.0);
        double bend = angle;
        if (!hinges->current_length) {
            bend -= hinges->rest_angle[i];
            bend -= TURN * std::nearbyint(bend / TURN);
        }
        energy[hinges->scene[i]] += 0.5 * factor * bend * bend;
        if (!gradient) continue;
        if (hinges->current_length) {
            const Vec along = (hinges->weight[i] * bend * bend) * e;
            add(gradient, c[1], along), add(gradient, c[0], -along);
        }
        if (!sound) continue;
        // The angle's slopes at the opposite vertices; those at the edge's ends follow from no net force and torque.
        const double pull = -factor * bend * length * scale;
        const Vec at_a = (pull / n1_sq) * n1, at_b = (pull / n2_sq) * n2;
        const Vec at_end = -((dot(edge, arm_a) / edge_sq) * at_a + (dot(edge, arm_b) / edge_sq) * at_b);
        add(gradient, c[2], at_a), add(gradient, c[3], at_b), add(gradient, c[1], at_end);
        add(gradient, c[0], -(at_a + at_b + at_end));
    }
}

// Absolute strain (E) of edges (E, 2) with lengths (E) [m] at rest.
void elements_strain(int64_t count, const int64_t* ends, const double* rest_length, const double* pos, double* strain) {
    for (int64_t i = 0; i < count; ++i) {
        const Vec d = at(pos, ends[2 * i + 1]) - at(pos, ends[2 * i]);
        strain[i] = std::fabs(std::sqrt(dot(d, d)) / rest_length[i] - 1.0);
    }
}
}
