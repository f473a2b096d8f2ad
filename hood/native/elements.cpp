// Energies of membrane and bending, and of what acts on single vertices, with their gradients, and edge strain: one pass over the
// elements of a cloth, in float64.
//
// Elements are taken as many at a time as a register holds; what they give is added up in their order, so that a result is the same in
// every run. Tables of elements are padded to a multiple of eight.
#include <algorithm>
#include <cmath>
#include <cstdint>

#include "element_laws.h"
#include "followed_contact.h"
#include "vector.h"
#include "vertex_terms.h"

namespace {

inline VN larger(VN a, VN b) { return a > b ? a : b; }
inline VN largest(const VN* a) { return larger(magnitude(a[0]), larger(magnitude(a[1]), magnitude(a[2]))); }

// Adds the energies of ``count`` lanes to their scenes.
inline void add_energy(VN value, const int32_t* scene, int count, double* energy) {
    for (int lane = 0; lane < count; ++lane) energy[scene[lane]] += value[lane];
}

// Adds forces on CORNERS corners of ``count`` elements, of a table of ``padded`` ones, to the gradient.
template <int CORNERS> inline void scatter(const VN (*force)[3], const int32_t* corners, int64_t padded, int count, double* gradient) {
    alignas(64) double table[CORNERS][3][AT_ONCE];
    for (int c = 0; c < CORNERS; ++c)
        for (int k = 0; k < 3; ++k) store(table[c][k], force[c][k]);
    for (int lane = 0; lane < count; ++lane)
        for (int c = 0; c < CORNERS; ++c)
            for (int k = 0; k < 3; ++k) gradient[3 * (int64_t)corners[c * padded + lane] + k] += table[c][k][lane];
}

}  // namespace

extern "C" {

struct Faces {
    int64_t count, padded;
    const int32_t *corners, *scene;                // (3, F), (F)
    const double *inverse, *weight, *mu, *lambda;  // (4, F) 1/m, (F) m^3, Pa, Pa
    const double* weave;  // (4, F) roots of the stiffness of cloth with warp and weft, see hood.energies.membrane; or none
};

struct Hinges {
    int64_t count, padded, current_length;  // 1: the code's form, with the edge's length now and about flat
    const int32_t *corners, *scene;         // (4, H), (H)
    const double *weight, *rest_angle;      // (H) J, or J/m^2 with the current length; rad
};

// Adds the membrane's energies [J] to those of the scenes, and its gradient (V, 3) [N] if there is room for it.
void elements_faces(const Faces* faces, const double* pos, double* energy, double* gradient) {
    const int64_t padded = faces->padded;
    for (int64_t i = 0; i < faces->count; i += AT_ONCE) {
        const int count = (int)std::min<int64_t>(AT_ONCE, faces->count - i);
        const int32_t* corners = faces->corners + i;
        VN offset[2][3], f[2][3], m[4];
        offsets_of<3, 3>(pos, corners, padded, offset);
        for (int c = 0; c < 4; ++c) m[c] = load<VN>(faces->inverse + c * padded + i);
        for (int a = 0; a < 2; ++a)
            for (int k = 0; k < 3; ++k) f[a][k] = m[a] * offset[0][k] + m[2 + a] * offset[1][k];
        const Strain g = green_strain(f);
        const VN weight = load<VN>(faces->weight + i);
        const auto add = [&](const auto& law) {
            add_energy(weight * density_of(law, g), faces->scene + i, count, energy);
            return stress_of(law, g, weight);
        };
        Stress s;
        if (faces->weave) {
            const double* roots = faces->weave + i;
            s = add(Weave{load<VN>(roots), load<VN>(roots + padded), load<VN>(roots + 2 * padded), load<VN>(roots + 3 * padded)});
        } else {
            s = add(Isotropic{load<VN>(faces->mu + i), load<VN>(faces->lambda + i)});
        }
        if (!gradient) continue;
        // First Piola-Kirchhoff stress F S, pulled back to the two edges.
        VN force[3][3];
        for (int k = 0; k < 3; ++k) {
            const VN p0 = s.s00 * f[0][k] + s.s01 * f[1][k], p1 = s.s01 * f[0][k] + s.s11 * f[1][k];
            force[1][k] = m[0] * p0 + m[1] * p1, force[2][k] = m[2] * p0 + m[3] * p1;
            force[0][k] = -(force[1][k] + force[2][k]);
        }
        scatter<3>(force, corners, padded, count, gradient);
    }
}

// The same for bending; hinges with a degenerate face have the angle 0 and no force.
void elements_hinges(const Hinges* hinges, const double* pos, double* energy, double* gradient) {
    const int64_t padded = hinges->padded;
    for (int64_t i = 0; i < hinges->count; i += AT_ONCE) {
        const int count = (int)std::min<int64_t>(AT_ONCE, hinges->count - i);
        const int32_t* corners = hinges->corners + i;
        VN offset[3][3], force[4][3];
        offsets_of<4, 3>(pos, corners, padded, offset);
        const VN* edge = offset[0];
        const VN scale = 1.0 / larger(larger(largest(edge), larger(largest(offset[1]), largest(offset[2]))), every(TINY));
        Hinge h;
        hinge_of(offset, scale, h);
        const VN weight = load<VN>(hinges->weight + i), factor = hinges->current_length ? weight * dot(edge, edge) : weight;
        const VN bend = hinges->current_length ? h.angle : bend_of(h.angle, load<VN>(hinges->rest_angle + i));
        add_energy(bending_energy(factor, bend), hinges->scene + i, count, energy);
        if (!gradient) continue;
        hinge_slopes(h, -factor * bend * h.length * scale, force);
        if (hinges->current_length) {
            const VN stretch = weight * bend * bend;
            for (int k = 0; k < 3; ++k) force[0][k] -= stretch * edge[k], force[1][k] += stretch * edge[k];
        }
        scatter<4>(force, corners, padded, count, gradient);
    }
}

// Along a direction (V, 3) [m]: adds the product of the membrane's Hessian with it to ``hessian`` (V, 3), and writes how the slope of the
// energy along it changes with every face's numbers, (9, F): weight; mu, lambda, 0, 0 or the roots of the weave; inverse rest edges.
void elements_faces_along(const Faces* faces, const double* pos, const double* direction, double* hessian, double* by) {
    const int64_t padded = faces->padded;
    for (int64_t i = 0; i < faces->count; i += AT_ONCE) {
        const int count = (int)std::min<int64_t>(AT_ONCE, faces->count - i);
        const int32_t* corners = faces->corners + i;
        VN offset[2][3], way[2][3], f[2][3], df[2][3], m[4], number[4] = {};
        offsets_of<3, 3>(pos, corners, padded, offset);
        offsets_of<3, 3>(direction, corners, padded, way);
        for (int c = 0; c < 4; ++c) m[c] = load<VN>(faces->inverse + c * padded + i);
        for (int a = 0; a < 2; ++a)
            for (int k = 0; k < 3; ++k) {
                f[a][k] = m[a] * offset[0][k] + m[2 + a] * offset[1][k];
                df[a][k] = m[a] * way[0][k] + m[2 + a] * way[1][k];
            }
        const Strain g = green_strain(f), dg = {dot(f[0], df[0]), 0.5 * (dot(f[0], df[1]) + dot(f[1], df[0])), dot(f[1], df[1])};
        const VN weight = load<VN>(faces->weight + i), one = every(1.0);
        Stress s, ds;
        if (faces->weave) {
            const double* roots = faces->weave + i;
            const Weave law = {load<VN>(roots), load<VN>(roots + padded), load<VN>(roots + 2 * padded), load<VN>(roots + 3 * padded)};
            s = stress_of(law, g, one), ds = stress_of(law, dg, one);
            const VN both = law.first * g.g00 + law.coupled * g.g11, along = law.first * dg.g00 + law.coupled * dg.g11;
            number[0] = g.g00 * along + dg.g00 * both, number[1] = g.g11 * along + dg.g11 * both;
            number[2] = 2.0 * law.second * g.g11 * dg.g11, number[3] = 8.0 * law.turn * g.g01 * dg.g01;
        } else {
            const Isotropic law = {load<VN>(faces->mu + i), load<VN>(faces->lambda + i)};
            s = stress_of(law, g, one), ds = stress_of(law, dg, one);
            number[0] = 2.0 * (g.g00 * dg.g00 + g.g11 * dg.g11 + 2.0 * g.g01 * dg.g01);
            number[1] = (g.g00 + g.g11) * (dg.g00 + dg.g11);
        }
        store(by + i, s.s00 * dg.g00 + 2.0 * s.s01 * dg.g01 + s.s11 * dg.g11);
        for (int c = 0; c < 4; ++c) store(by + (1 + c) * padded + i, weight * number[c]);
        VN p[2][3], dp[2][3], force[3][3];
        for (int k = 0; k < 3; ++k) {
            p[0][k] = weight * (s.s00 * f[0][k] + s.s01 * f[1][k]), p[1][k] = weight * (s.s01 * f[0][k] + s.s11 * f[1][k]);
            dp[0][k] = weight * (s.s00 * df[0][k] + s.s01 * df[1][k] + ds.s00 * f[0][k] + ds.s01 * f[1][k]);
            dp[1][k] = weight * (s.s01 * df[0][k] + s.s11 * df[1][k] + ds.s01 * f[0][k] + ds.s11 * f[1][k]);
            force[1][k] = m[0] * dp[0][k] + m[1] * dp[1][k], force[2][k] = m[2] * dp[0][k] + m[3] * dp[1][k];
            force[0][k] = -(force[1][k] + force[2][k]);
        }
        for (int c = 0; c < 4; ++c)
            store(by + (5 + c) * padded + i, dot(offset[c / 2], dp[c % 2]) + dot(way[c / 2], p[c % 2]));
        scatter<3>(force, corners, padded, count, hessian);
    }
}

// The same of bending about the rest shape; (2, H) by weight and rest angle.
void elements_hinges_along(const Hinges* hinges, const double* pos, const double* direction, double* hessian, double* by) {
    const int64_t padded = hinges->padded;
    for (int64_t i = 0; i < hinges->count; i += AT_ONCE) {
        const int count = (int)std::min<int64_t>(AT_ONCE, hinges->count - i);
        const int32_t* corners = hinges->corners + i;
        VN offset[3][3], way[3][3], slope[4][3], change[4][3];
        offsets_of<4, 3>(pos, corners, padded, offset);
        offsets_of<4, 3>(direction, corners, padded, way);
        const VN scale = 1.0 / larger(larger(largest(offset[0]), larger(largest(offset[1]), largest(offset[2]))), every(TINY));
        Hinge h;
        hinge_of(offset, scale, h);
        const VN pull = -h.length * scale, weight = load<VN>(hinges->weight + i), bend = bend_of(h.angle, load<VN>(hinges->rest_angle + i));
        hinge_slopes(h, pull, slope);
        hinge_slopes_along(h, pull, scale, slope, way, change);
        const VN turned = dot(slope[1], way[0]) + dot(slope[2], way[1]) + dot(slope[3], way[2]);
        store(by + i, bend * turned);
        store(by + padded + i, -weight * turned);
        for (int c = 0; c < 4; ++c)
            for (int k = 0; k < 3; ++k) change[c][k] = weight * (turned * slope[c][k] + bend * change[c][k]);
        scatter<4>(change, corners, padded, count, hessian);
    }
}

// What acts on single vertices: inertia, gravity, collision and friction terms.
struct Vertices {
    int64_t count, num_scenes, num_walls, num_grips;
    const int64_t* scene;                          // (V)
    const double *inertia, *stiffness, *weight;    // (V) kg, (V) N/m, (V, 3) N
    const double* dt;                              // (B) s
    const Wall* walls;
    const Grip* grips;
};

// Adds the energies [J] (2 + W + G, B) of inertia, gravity, walls and grips at positions and accelerations (V, 3), and their
// gradient (V, 3) [N] if there is room for it.
void elements_vertices(const Vertices* all, const double* pos, const double* acc, double* energy, double* gradient) {
    const int64_t scenes = all->num_scenes;
    for (int64_t v = 0; v < all->count; ++v) {
        const int64_t scene = all->scene[v];
        const double *x = pos + 3 * v, *a = acc + 3 * v, *weight = all->weight + 3 * v, dt_sq = all->dt[scene] * all->dt[scene];
        energy[scene] += 0.5 * all->stiffness[v] * dt_sq * dt_sq * dot3(a, a);
        energy[scenes + scene] -= dot3(weight, x);
        double force[3];
        for (int k = 0; k < 3; ++k) force[k] = all->inertia[v] * a[k] - weight[k];
        for (int64_t w = 0; w < all->num_walls; ++w) {
            const Wall& wall = all->walls[w];
            energy[(2 + w) * scenes + scene] += wall_energy(wall, v, x);
            const double depth = depth_of(wall, v, x);
            if (depth <= 0.0) continue;
            for (int k = 0; k < 3; ++k) force[k] -= contact_force(weight_of(wall, v), depth) * wall.normal[3 * v + k];
        }
        for (int64_t w = 0; w < all->num_grips; ++w) {
            const Grip& grip = all->grips[w];
            if (!(grip.force[v] > 0.0)) continue;
            energy[(2 + all->num_walls + w) * scenes + scene] += grip_energy(grip, v, x);
            double slip[3];
            const double slope = slope_of(grip, v, slip_of(grip, v, x, slip));
            for (int k = 0; k < 3; ++k) force[k] += slope * slip[k];
        }
        if (gradient)
            for (int k = 0; k < 3; ++k) gradient[3 * v + k] += force[k];
    }
}

// The contact of a step as it was searched for, see hood.contact.contact.Contact, and what tells how hard vertices are pressed on it.
struct Contact {
    int64_t count;
    const uint8_t* valid;                                           // (V)
    const int64_t* scene;                                           // (V)
    const double *mass, *pos, *vel;                                 // (V) kg, (V, 3) m, (V, 3) m/s
    const double *dist, *chord_error;                                       // (V) m, (V) m, see hood.contact.activation_distance
    const double *point, *next_point, *next_normal;                 // (V, 3) m, (V, 3) m, (V, 3)
    const double *pull, *dt, *gravity;                              // (V, 3) N or none, (B) s, (3) m/s^2
};

// How far off the skin contact sets in, see hood.contact.activation_distance: ``least`` [m], and the chord error as well unless it is the same everywhere.
struct Reach {
    double least;
    int64_t curved;
};

inline bool touches(const Contact& contact, int64_t v) { return contact.valid[v] && contact.mass[v] > 0.0; }

inline double reach_of(const Contact& contact, const Reach& reach, int64_t v) {
    return reach.least + (reach.curved ? contact.chord_error[v] : 0.0);
}

// A collision term's planes and their reach, see hood.energies.contact; rows that touch nothing are zero.
void elements_wall(const Contact* all, const Reach* reach, double* point, double* normal, double* reaches) {
    for (int64_t v = 0; v < all->count; ++v) {
        const bool touching = touches(*all, v);
        for (int64_t i = 3 * v; i < 3 * v + 3; ++i) {
            point[i] = touching ? all->next_point[i] : 0.0;
            normal[i] = touching ? all->next_normal[i] : 0.0;
        }
        reaches[v] = touching ? reach_of(*all, *reach, v) : 0.0;
    }
}

// A friction term's lagged force, see hood.energies.friction.Friction, and what the slip is measured against; rows without force are
// zero but for the last two.
void elements_grip(const Contact* all, const Reach* reach, double weight, double coefficient, double slip_speed, double* normal,
                   double* anchor, double* force, double* limit) {
    for (int64_t v = 0; v < all->count; ++v) {
        const double dt = all->dt[all->scene[v]];
        const double *pos = all->pos + 3 * v, *up = all->next_normal + 3 * v, *goal = all->next_point + 3 * v;
        double pressed = 0.0;
        if (touches(*all, v)) {
            const double apart = reach_of(*all, *reach, v), depth = std::max(apart - all->dist[v], 0.0);
            pressed = contact_force(weight, depth);
            if (all->pull && pressed > 0.0) {
                double gap[3];
                for (int k = 0; k < 3; ++k) gap[k] = pos[k] + dt * (all->vel[3 * v + k] + dt * all->gravity[k]) - goal[k];
                const double flown = apart - dot3(gap, up), pull = dot3(all->pull + 3 * v, up);
                const double most = all->mass[v] / (dt * dt) * (flown < 0.0 ? 0.0 : flown) - (pull > 0.0 ? 0.0 : pull);
                pressed = most > pressed ? pressed : most;  // not-a-number stays
            }
        }
        force[v] = coefficient * pressed, limit[v] = slip_speed * dt;
        for (int k = 0; k < 3; ++k) {
            normal[3 * v + k] = force[v] > 0.0 ? up[k] : 0.0;
            anchor[3 * v + k] = pos[k] + (force[v] > 0.0 ? goal[k] - all->point[3 * v + k] : 0.0);
        }
    }
}

// Adds how the force of a term on the body, along a direction (V, 3), changes with what is followed, to (V, 16): positions at t,
// velocities, forces of the cloth around, mass, factor of friction, mean square of the edges, their growth, and what it is.
void elements_followed(const Followed* all, const FollowedTerm* term, const double* direction, double* by) {
    for (int64_t v = 0; v < all->count; ++v) {
        const double* way = direction + 3 * v;
        if (!(all->mass[v] > 0.0) || (way[0] == 0.0 && way[1] == 0.0 && way[2] == 0.0)) continue;
        bool acts = false;
        const double work = work_at<double>(*all, *term, v, way, &acts);
        if (!acts) continue;  // most vertices touch nothing
        const Dual followed = work_at<Dual>(*all, *term, v, way, &acts);
        for (int k = 0; k < 13; ++k) by[SLOPES * v + k] += followed.d[k];
        by[SLOPES * v + 13] += work;
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
