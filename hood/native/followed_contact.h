// Contact and friction on the body as functions of the positions at t, and how what they do along a direction changes with these, with the
// velocities and with the cloth's numbers: forward differentiation of what hood/contact/contact.py, hood/contact/sample_points.py,
// hood/energies/contact.py and hood/energies/friction.py say of one vertex.
#pragma once
#include <cmath>
#include <cstdint>

#include "laws.h"

extern "C" {

// A contact as it was searched for; rows of vertices.
struct FollowedContact {
    const uint8_t* valid;
    const int64_t* face;
    const double *bary, *dist, *normal, *raised;  // (V, 3), (V) m, (V, 3), (V) m or none
};

struct Followed {
    int64_t count;
    // The body.
    const int64_t* faces;                                                   // (G, 3)
    const double *surface, *next_surface, *normals, *next_normals, *curvature;  // (W, 3) m and unit normals, (W) 1/m
    const double* friction_scale;                                           // (G) or none
    FollowedContact first, second;  // without faces where there is no second one
    // The cloth.
    const int64_t* scene;
    const double *mass, *friction, *edge_sq, *growth;  // (V) kg, factors, m^2, m^2 or none
    const double *pos, *vel, *pull, *next_pos;         // (V, 3) m, m/s, N or none, m
    const double *dt, *gravity;                        // (B) s, (3) m/s^2
    // Laws: how far ahead the other side of a fold is looked for [m], and those of hood.contact.sample_points.
    double ahead, sag_share, most_sag, most_stretched;
};

// A term: of contact without a coefficient.
struct FollowedTerm {
    double weight, least;  // J/m^3, m
    int64_t curved;
    double coefficient, slip_speed;
};
}

namespace {

constexpr int SLOPES = 16;  // pos 0 1 2, velocity 3 4 5, pull 6 7 8, mass 9, friction 10, edge_sq 11, growth 12
typedef double Slopes __attribute__((vector_size(8 * SLOPES)));

struct Dual {
    double v;
    Slopes d;
};
inline Dual operator+(const Dual& a, const Dual& b) { return {a.v + b.v, a.d + b.d}; }
inline Dual operator-(const Dual& a, const Dual& b) { return {a.v - b.v, a.d - b.d}; }
inline Dual operator*(const Dual& a, const Dual& b) { return {a.v * b.v, a.v * b.d + b.v * a.d}; }
inline Dual operator/(const Dual& a, const Dual& b) { return {a.v / b.v, (a.d - (a.v / b.v) * b.d) / b.v}; }
inline Dual operator+(const Dual& a, double b) { return {a.v + b, a.d}; }
inline Dual operator+(double a, const Dual& b) { return b + a; }
inline Dual operator-(const Dual& a, double b) { return {a.v - b, a.d}; }
inline Dual operator-(double a, const Dual& b) { return {a - b.v, -b.d}; }
inline Dual operator*(double a, const Dual& b) { return {a * b.v, a * b.d}; }
inline Dual operator*(const Dual& a, double b) { return b * a; }
inline Dual operator/(const Dual& a, double b) { return {a.v / b, a.d / b}; }

inline double value_of(double a) { return a; }
inline double value_of(const Dual& a) { return a.v; }
inline double root_of(double a) { return std::sqrt(a); }
inline Dual root_of(const Dual& a) {
    const double size = std::sqrt(a.v);
    return size > 0.0 ? Dual{size, a.d / (2.0 * size)} : Dual{0.0, Slopes{}};  // the root has no slope at 0
}
template <class T> inline T least_of(const T& a, double b) { return value_of(a) < b ? a : T{} + b; }
template <class T> inline T positive(const T& a) { return value_of(a) > 0.0 ? a : T{}; }
template <class A, class B> inline auto along(const A* a, const B* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

inline void variable(double& x, double value, int) { x = value; }
inline void variable(Dual& x, double value, int place) { x = {value, Slopes{}}, x.d[place] = 1.0; }

// Where a vertex is matched with the body.
template <class T> struct Matched {
    T point[3], normal[3], next_point[3], next_normal[3], curvature, dist;
};

// Weights of the point of a triangle nearest to a place, on the face, edge or corner that the known ones are on; those themselves where
// the place is another one than that they were found for.
template <class T> inline void follow_weights(const T* place, const double (*corner)[3], const double* known, T* weights) {
    for (int c = 0; c < 3; ++c) weights[c] = T{} + known[c];
    int out = -1, inside = 0;
    for (int c = 0; c < 3; ++c) known[c] > 0.0 ? (void)++inside : (void)(out = c);
    T found[3] = {};
    if (inside == 3) {
        double first[3], second[3];
        T offset[3];
        for (int k = 0; k < 3; ++k) {
            first[k] = corner[1][k] - corner[0][k], second[k] = corner[2][k] - corner[0][k], offset[k] = place[k] - corner[0][k];
        }
        const double a = along(first, first), b = along(first, second), c = along(second, second), area = a * c - b * b;
        const T p = along(offset, first), q = along(offset, second);
        found[1] = (c * p - b * q) / area, found[2] = (a * q - b * p) / area, found[0] = 1.0 - found[1] - found[2];
    } else if (inside == 2) {
        const int start = (out + 1) % 3, end = (out + 2) % 3;
        double edge[3];
        T way[3];
        for (int k = 0; k < 3; ++k) edge[k] = corner[end][k] - corner[start][k], way[k] = place[k] - corner[start][k];
        found[end] = along(way, edge) / along(edge, edge), found[start] = 1.0 - found[end];
    } else {
        return;
    }
    for (int c = 0; c < 3; ++c)
        if (!(std::fabs(value_of(found[c]) - known[c]) < 1e-6)) return;
    for (int c = 0; c < 3; ++c) weights[c] = found[c];
}

template <class T> inline Matched<T> match_at(const Followed& all, const FollowedContact& contact, int64_t v, const T* place) {
    const int64_t* vertex = all.faces + 3 * contact.face[v];
    double corner[3][3];
    for (int c = 0; c < 3; ++c)
        for (int k = 0; k < 3; ++k) corner[c][k] = all.surface[3 * vertex[c] + k];
    T weights[3];
    follow_weights(place, corner, contact.bary + 3 * v, weights);
    Matched<T> m = {};
    for (int c = 0; c < 3; ++c) {
        for (int k = 0; k < 3; ++k) {
            const int64_t at = 3 * vertex[c] + k;
            m.point[k] = m.point[k] + weights[c] * corner[c][k], m.normal[k] = m.normal[k] + weights[c] * all.normals[at];
            m.next_point[k] = m.next_point[k] + weights[c] * all.next_surface[at];
            m.next_normal[k] = m.next_normal[k] + weights[c] * all.next_normals[at];
        }
        m.curvature = m.curvature + weights[c] * all.curvature[vertex[c]];
    }
    const T size = root_of(along(m.normal, m.normal)), next_size = root_of(along(m.next_normal, m.next_normal));
    for (int k = 0; k < 3; ++k) {
        if (value_of(size) > 0.0) m.normal[k] = m.normal[k] / size;
        if (value_of(next_size) > 0.0) m.next_normal[k] = m.next_normal[k] / next_size;
    }
    return m;
}

// What a term does to a vertex along a direction, (force) . (direction), and whether it acts at all.
template <class T> inline T work_of(const Followed& all, const FollowedTerm& term, int64_t v, const FollowedContact& contact, const Matched<T>& m, const T* pos,
                                       const double* direction, bool* acts) {
    const double dt = all.dt[all.scene[v]], *next = all.next_pos + 3 * v;
    T reach = T{} + term.least;
    if (term.curved) {
        T edge_sq, growth;
        variable(edge_sq, all.edge_sq[v], 11);
        const T share = all.sag_share * m.curvature;
        reach = reach + least_of(share * edge_sq, all.most_sag);
        if (contact.raised) reach = reach + contact.raised[v];
        if (all.growth) {
            variable(growth, all.growth[v], 12);
            reach = reach + least_of(share * growth, all.most_stretched);
        }
    }
    T gap[3];
    if (!(term.coefficient > 0.0)) {
        for (int k = 0; k < 3; ++k) gap[k] = next[k] - m.next_point[k];
        const T depth = positive(reach - along(gap, m.next_normal));
        *acts |= value_of(depth) > 0.0;
        return -3.0 * term.weight * (depth * depth * along(m.next_normal, direction));
    }
    const T deep = positive(reach - m.dist);
    T pressed = 3.0 * term.weight * (deep * deep);
    if (all.pull) {
        T pull[3], speed[3], mass;
        variable(mass, all.mass[v], 9);
        for (int k = 0; k < 3; ++k) {
            variable(speed[k], all.vel[3 * v + k], 3 + k), variable(pull[k], all.pull[3 * v + k], 6 + k);
            gap[k] = pos[k] + dt * (speed[k] + dt * all.gravity[k]) - m.next_point[k];
        }
        const T flown = positive(reach - along(gap, m.next_normal)), drawn = positive(-1.0 * along(pull, m.next_normal));
        const T most = mass * flown / (dt * dt) + drawn;
        if (value_of(most) < value_of(pressed)) pressed = most;
    }
    T friction;
    variable(friction, all.friction[v], 10);
    const double scale = term.coefficient * (all.friction_scale ? all.friction_scale[contact.face[v]] : 1.0), limit = term.slip_speed * dt;
    const T force = scale * (friction * pressed);
    if (!(value_of(force) > 0.0)) return T{};
    *acts = true;
    T slip[3];
    for (int k = 0; k < 3; ++k) slip[k] = next[k] - pos[k] - m.next_point[k] + m.point[k];
    const T up = along(slip, m.next_normal);
    for (int k = 0; k < 3; ++k) slip[k] = slip[k] - up * m.next_normal[k];
    const T size = root_of(along(slip, slip));
    const T slope = value_of(size) < limit ? (2.0 - size / limit) / limit : (T{} + 1.0) / size;
    return force * slope * along(slip, direction);
}

// The same at all contacts of a vertex.
template <class T> inline T work_at(const Followed& all, const FollowedTerm& term, int64_t v, const double* direction, bool* acts) {
    T pos[3], place[3], sum = {};
    for (int k = 0; k < 3; ++k) variable(pos[k], all.pos[3 * v + k], k), place[k] = T{} + all.first.normal[3 * v + k];
    if (all.first.valid[v]) {
        Matched<T> m = match_at(all, all.first, v, pos);
        T gap[3];
        for (int k = 0; k < 3; ++k) gap[k] = pos[k] - m.point[k], place[k] = m.normal[k];
        const double dist = all.first.dist[v];
        m.dist = dist > 0.0 ? root_of(along(gap, gap)) : dist < 0.0 ? -1.0 * root_of(along(gap, gap)) : T{} + dist;
        sum = work_of(all, term, v, all.first, m, pos, direction, acts);
    }
    if (all.second.face && all.second.valid[v]) {
        for (int k = 0; k < 3; ++k) place[k] = pos[k] + all.ahead * place[k];
        Matched<T> m = match_at(all, all.second, v, place);
        T gap[3];
        for (int k = 0; k < 3; ++k) gap[k] = pos[k] - m.point[k];
        m.dist = along(gap, m.normal);
        sum = sum + work_of(all, term, v, all.second, m, pos, direction, acts);
    }
    return sum;
}

}  // namespace
