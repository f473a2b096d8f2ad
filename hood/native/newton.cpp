// One scene's implicit step by projected Newton: energies, gradient, Hessian, conjugate gradients and line search.
//
// Everything lives in arrays that the caller owns (hood/solver/compiled/newton.py), so nothing here allocates. Vertices are numbered anew:
// the free ones first, in an order that keeps neighbours near each other, then the fixed ones. A table of triples is padded to four
// numbers a row. Elements are taken as many at a time as a register holds, in float64; a row of 3 x 3 blocks is then gathered from the
// elements at its vertex, in cache, and written once: no two writers, a fixed order, the same bits in every run. Of the symmetric
// matrix a row keeps its diagonal block, which comes first, and those of later columns; the linear system takes rows in pairs. Loops
// over elements and rows are shared by threads where the cloth is large enough: in parts, each with its own sums, which are then added
// in their order.
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

#include "element_laws.h"
#include "layer_grips.h"
#include "layer_view.h"
#include "pairs.h"
#include "threads.h"
#include "vertex_terms.h"

namespace {

typedef double D4 __attribute__((vector_size(32)));
#ifdef WIDE  // a library of its own: few scenes need it
typedef double Real;  // of the matrix and the linear solver
#else
typedef float Real;
#endif

}  // namespace

extern "C" {

// Walls, grips and drag at points inside edges and faces, weighted sums of up to three vertices; rows of points where those are of vertices.
struct Points {
    int64_t count, num_walls, num_grips, num_drags;
    const int32_t* corners;  // (N, 3), in the new numbering; what is not needed repeats one
    const double* weights;   // (N, 3), 0 for those
    // Points at a row's vertex: (R + 1) starts; (., 5) point, corner, then places in the row of the blocks with the point's
    // corners, 0 where there is none or another row keeps it.
    const int32_t *starts, *uses;
    const Wall* walls;
    const Grip* grips;
    const Drag* drags;
    double* model;  // (N, 16) gradient, matrix and indefinite part by the point, and 1 where there are any
    double* path;   // (W, N, 14) of the line search: give of the corners, compliance, depth, 1 where it acts, push
};

// Energies that the caller computes: J at positions (V, 4), and of free vertices, where ``model`` was called last, gradient (N, 3)
// and upper triangles of a positive block (N, 6).
struct OtherTerms {
    double (*energy)(const double* pos);
    void (*model)(const double* pos);
    const double *gradient, *own;
};

struct Engine {
    // The cloth: constant as long as its plan.
    int64_t num_vertices, num_rows, num_faces, num_hinges, num_springs, most_blocks;  // elements padded to a multiple of 8
    const int64_t* vertex;                        // (V) original number of each vertex
    const int32_t *face_corners, *hinge_corners;  // (3, F), (4, H)
    const int32_t* row_starts;                    // (N + 1) blocks of the rows
    // Rows of the linear system in pairs of no neighbours, P of them: a sliced ELLPACK format of two rows (Kreutzer et al. 2014).
    int64_t num_pairs;
    const int32_t *slot, *row_of_slot;            // (N) twice the pair, and 1 in its second half; (2 P), -1 where a half is empty
    const int32_t *pair_starts, *pair_cols;       // (P + 1), (., 2) slots of the columns; where a row is shorter, its own
    // Elements at a row's vertex, those with the most blocks in the row first: (C N + 1) starts for elements of C corners, with
    // C, ..., 1 blocks; (., 1 + C) 4 element + corner, then 4 place in the row + corner of its blocks, the diagonal first.
    const int32_t *face_starts, *face_uses, *hinge_starts, *hinge_uses, *spring_starts, *spring_uses;
    const int32_t* spring_ends;                   // (2, A)
    // The fabric: constant as long as the cloth's numbers.
    const double *shape, *area, *mu, *lambda, *bulk, *soft;  // (6, F) 1/m, (F) m^3, Pa, Pa and roots of moduli times area
    const double *rest_angle, *hinge_weight, *rest_length;   // (H)
    // Cloth with warp and weft: (4, F) roots of its stiffness, see hood.energies.membrane, in place of mu, lambda, bulk and soft; or none.
    const double* weave;
    // Damping in the step: viscous stress or moment over the elastic one of what the step adds, and the shape before; or none.
    const double *face_rate, *face_before;    // (F), (3, F) Green strains
    const double *hinge_rate, *hinge_before;  // (H), (H) angles
    // The step.
    const double *base, *fixed;  // (V, 3) m: free flight, and where fixed vertices are
    const double *inertia, *weight;  // (V) kg, (V, 3) N
    const double *spring_stiffness, *spring_target;  // (A) N/m, (A, 4) m: what the difference of the ends is drawn to
    const Wall* walls;
    const Grip* grips;
    const Points* points;
    int64_t num_walls, num_grips, num_points;
    int64_t bending;  // 0 none, 1 about the rest shape, 2 with the current length about flat
    int64_t membrane;
    double dt_sq;
    // The state.
    double *pos, *acc;              // (V, 4), (N, 4)
    double *trial_pos, *trial_acc;  // the same
    double *gradient, *direction;   // (N, 4)
    double *path;                   // (W, N, 8) stops of the line search: give, compliance, depth, of every wall
    double *face_force, *hinge_force;  // (F, 10), (H, 14) gradients by corner, then axis, and what loads of four read beyond
    void *face_model, *hinge_model; // records of the elements, see below, of float or double like the rest
    void *matrix, *indefinite_part;           // (., 3, 2, 4) axis by half, of the blocks of pairs, and (R)
    void *own, *own_indefinite_part;          // (N, 6) what acts on single vertices
    void *row_sum;                  // (parts, most_blocks, 16), aligned to 32 bytes
    void *block, *inverse, *x, *r, *z, *p, *q; // (P, 3, 2, 4) twice, (P, 2, 4) five times; 0 in empty halves
    double indefinite_share, raised;       // of the matrix as it stands, and of the next one
    double phi, noise;
    int64_t modelled;               // whether records and forces of the elements are those of the state
    int64_t cg_used;
    // Threads.
    int64_t parts, reach;           // in how many parts loops are done; how far a column is behind its row at most
    const int32_t* border;          // (K) rows with neighbours in other parts
    const double* outside;          // (K) which share of their neighbours these are
    void* border_blocks;            // (K, 24)
    int64_t num_border;
    // (N, 3) blocks between rows of two parts: the slot that is added to, the slot of the other row, where the block is in the matrix.
    // Of every part those that act transposed, then those that act as they are; where these groups begin (2 parts + 1).
    const int32_t *outer_blocks, *outer_starts;
    // Cloth near cloth; none where there is no such term.
    LayerView* layers;
    const int64_t* vertex_of_scene;  // (V) number of each vertex in them
    double kept;                     // share of a distance that a move leaves
    double eased;                    // share of a move below which it is bent around cloth
    const LayerGrips* layer_grips;   // friction between them; none where there is no such term
    const OtherTerms* others;        // none where this file knows every term
};
}

namespace {

inline Range rows_of(const Engine& e, int64_t part) { return range_of(e.num_rows, part, e.parts); }
inline Range pairs_of(const Engine& e, int64_t part) { return range_of(e.num_pairs, part, e.parts); }
inline Range faces_of(const Engine& e, int64_t part) { return range_of(e.num_faces, part, e.parts, AT_ONCE); }
inline Range hinges_of(const Engine& e, int64_t part) { return range_of(e.num_hinges, part, e.parts, AT_ONCE); }

// A number of every part, a line of the cache each; added in their order.
template <class V> struct Sums {
    struct alignas(64) Line {
        V value;
    } line[MOST_PARTS];

    V& operator[](int64_t part) { return line[part].value; }
    V total(int64_t parts) const {
        V sum = line[0].value;
        for (int64_t part = 1; part < parts; ++part) sum += line[part].value;
        return sum;
    }
};

// ---- elements ------------------------------------------------------------------------------------------------------------

template <class T> struct FaceRecord {
    T root[28];   // three vectors over the corners whose outer products are the material part; a spare one for loads of four
    T axial[14];  // pairs of corners 00 01 02 11 12 22: what acts on the three axes alike, and its indefinite part
};
template <class T> struct HingeRecord {
    T row[14];
};

inline Strain strain_of(const Engine& e, const double* pos, int64_t i, VN (*f)[3]) {
    VN offset[2][3];
    offsets_of<3, 4>(pos, e.face_corners + i, e.num_faces, offset);
    for (int a = 0; a < 2; ++a) {
        const VN one = load<VN>(e.shape + (3 * a + 1) * e.num_faces + i), two = load<VN>(e.shape + (3 * a + 2) * e.num_faces + i);
        for (int k = 0; k < 3; ++k) f[a][k] = offset[0][k] * one + offset[1][k] * two;
    }
    return green_strain(f);
}

// What the step has added to strains.
inline Strain since_start(const Engine& e, int64_t i, const Strain& g) {
    const double* before = e.face_before + i;
    return {g.g00 - load<VN>(before), g.g01 - load<VN>(before + e.num_faces), g.g11 - load<VN>(before + 2 * e.num_faces)};
}

inline Isotropic isotropic_of(const Engine& e, int64_t i) { return {load<VN>(e.mu + i), load<VN>(e.lambda + i)}; }

inline Weave weave_of(const Engine& e, int64_t i) {
    const double* roots = e.weave + i;
    return {load<VN>(roots), load<VN>(roots + e.num_faces), load<VN>(roots + 2 * e.num_faces), load<VN>(roots + 3 * e.num_faces)};
}

template <auto law_of> double face_energy(const Engine& e, const double* pos, Range range) {
    double sum = 0.0;
    for (int64_t i = range.begin; i < range.end; i += AT_ONCE) {
        VN f[2][3];
        const Strain g = strain_of(e, pos, i, f);
        const auto law = law_of(e, i);
        sum += total(load<VN>(e.area + i) * density_of(law, g));
        if (!e.face_rate) continue;
        sum += total(load<VN>(e.area + i) * load<VN>(e.face_rate + i) * density_of(law, since_start(e, i, g)));
    }
    return sum;
}

// The records and forces at positions; the energy of the faces.
template <class T> double face_models(const Engine& e, const double* pos, Range range) {
    FaceRecord<T>* records = (FaceRecord<T>*)e.face_model;
    const VN zero = every(0.0), one = every(1.0);
    double sum = 0.0;
    for (int64_t i = range.begin; i < range.end; i += AT_ONCE) {
        VN f[2][3];
        const Strain g = strain_of(e, pos, i, f);
        const VN area = load<VN>(e.area + i);
        const auto stress = [&](const auto& law) {
            Stress s = stress_of(law, g, one);
            sum += total(area * density_of(law, g));
            if (e.face_rate) {
                const VN rate = load<VN>(e.face_rate + i);
                const Strain added = since_start(e, i, g);
                const Stress viscous = stress_of(law, added, rate);
                s.s00 += viscous.s00, s.s01 += viscous.s01, s.s11 += viscous.s11;
                sum += total(area * rate * density_of(law, added));
            }
            return s;
        };
        const VN stiffer = e.face_rate ? root(1.0 + load<VN>(e.face_rate + i)) : one;
        const VN bulk = load<VN>(e.bulk + i) * stiffer, soft = load<VN>(e.soft + i) * stiffer;
        Weave weave;
        Stress s;
        if (e.weave) {
            weave = weave_of(e, i);
            s = stress(weave);
            const VN size = root(area) * stiffer;
            weave.first *= size, weave.coupled *= size, weave.second *= size, weave.turn *= size;
        } else {
            s = stress(isotropic_of(e, i));
        }
        // The positive part of the stress, from the eigenvalues of a 2 x 2 matrix.
        const VN mean = 0.5 * (s.s00 + s.s11), half = 0.5 * (s.s00 - s.s11), radius = root(half * half + s.s01 * s.s01);
        const VN most = mean + radius, least = mean - radius;
        const VN high = most > zero ? most : zero, low = least > zero ? least : zero;
        const VN centre = 0.5 * (high + low), slope = radius > zero ? 0.5 * (high - low) / (radius > zero ? radius : one) : zero;
        const VN t00 = centre + slope * half, t01 = slope * s.s01, t11 = centre - slope * half;
        VN b0[3], b1[3], pull0[3], pull1[3], ten0[3], ten1[3];
        for (int c = 0; c < 3; ++c) {
            b0[c] = load<VN>(e.shape + c * e.num_faces + i);
            b1[c] = load<VN>(e.shape + (3 + c) * e.num_faces + i);
            const VN w0 = area * b0[c], w1 = area * b1[c];
            pull0[c] = s.s00 * w0 + s.s01 * w1, pull1[c] = s.s01 * w0 + s.s11 * w1;
            ten0[c] = t00 * w0 + t01 * w1, ten1[c] = t01 * w0 + t11 * w1;
        }
        VN force[9], roots[28], axial[12];
        for (int c = 0; c < 3; ++c)
            for (int k = 0; k < 3; ++k) {
                const int at = 3 * c + k;
                force[at] = pull0[c] * f[0][k] + pull1[c] * f[1][k];
                const VN along = b0[c] * f[0][k], across = b1[c] * f[1][k], both = b0[c] * f[1][k] + b1[c] * f[0][k];
                if (e.weave) {
                    roots[at] = weave.first * along + weave.coupled * across;
                    roots[9 + at] = weave.second * across, roots[18 + at] = weave.turn * both;
                } else {
                    roots[at] = bulk * (along + across), roots[9 + at] = soft * (along - across), roots[18 + at] = soft * both;
                }
            }
        roots[27] = zero;
        int place = 0;
        for (int c = 0; c < 3; ++c)
            for (int d = c; d < 3; ++d, place += 2) {
                axial[place] = ten0[c] * b0[d] + ten1[c] * b1[d];
                axial[place + 1] = pull0[c] * b0[d] + pull1[c] * b1[d] - axial[place];
            }
        store_by_lane<9, 10>(force, e.face_force + 10 * i);
        store_by_lane<28, sizeof(FaceRecord<T>) / sizeof(T)>(roots, records[i].root);
        store_by_lane<12, sizeof(FaceRecord<T>) / sizeof(T)>(axial, records[i].axial);
    }
    return sum;
}

// The hinge in units of its edge at rest; returns how many of them make a metre.
inline VN hinge_of(const Engine& e, const double* pos, int64_t i, VN (*offset)[3], Hinge& h) {
    offsets_of<4, 4>(pos, e.hinge_corners + i, e.num_hinges, offset);
    const VN per_unit = 1.0 / load<VN>(e.rest_length + i);
    hinge_of(offset, per_unit, h);
    return per_unit;
}

double hinge_energy(const Engine& e, const double* pos, Range range) {
    double sum = 0.0;
    for (int64_t i = range.begin; i < range.end; i += AT_ONCE) {
        Hinge h;
        VN offset[3][3];
        const VN per_unit = hinge_of(e, pos, i, offset, h), weight = load<VN>(e.hinge_weight + i);
        if (e.bending == 2) {
            sum += total(bending_energy(weight, h.angle * per_unit) * dot(offset[0], offset[0]));
        } else {
            sum += total(bending_energy(weight, bend_of(h.angle, load<VN>(e.rest_angle + i))));
            if (!e.hinge_rate) continue;
            const VN added = bend_of(h.angle, load<VN>(e.hinge_before + i));
            sum += total(bending_energy(load<VN>(e.hinge_rate + i) * weight, added));
        }
    }
    return sum;
}

// The records and forces at positions; the energy of the hinges.
template <class T> double hinge_models(const Engine& e, const double* pos, Range range) {
    HingeRecord<T>* records = (HingeRecord<T>*)e.hinge_model;
    const VN zero = every(0.0), one = every(1.0);
    double sum = 0.0;
    for (int64_t i = range.begin; i < range.end; i += AT_ONCE) {
        Hinge h;
        VN offset[3][3], slope[4][3];
        const VN per_unit = hinge_of(e, pos, i, offset, h), *edge = offset[0];
        hinge_slopes(h, -h.length * per_unit, slope);
        VN residual;
        if (e.bending == 2) {
            const VN length = root(dot(edge, edge)), ratio = length * per_unit;
            residual = h.angle * ratio;
            const VN along = h.angle * per_unit / (length > zero ? length : one);
            for (int k = 0; k < 3; ++k) {
                for (int c = 0; c < 4; ++c) slope[c][k] *= ratio;
                slope[0][k] -= along * edge[k];
                slope[1][k] += along * edge[k];
            }
        } else {
            residual = bend_of(h.angle, load<VN>(e.rest_angle + i));
        }
        const VN weight = load<VN>(e.hinge_weight + i);
        VN force = weight * residual, size = root(weight), pull[12], row[12];
        sum += total(bending_energy(weight, residual));
        if (e.hinge_rate) {
            const VN rate = load<VN>(e.hinge_rate + i), added = bend_of(h.angle, load<VN>(e.hinge_before + i));
            force += rate * weight * added;
            size *= root(1.0 + rate);
            sum += total(bending_energy(rate * weight, added));
        }
        for (int c = 0; c < 4; ++c)
            for (int k = 0; k < 3; ++k) pull[3 * c + k] = force * slope[c][k], row[3 * c + k] = size * slope[c][k];
        store_by_lane<12, 14>(pull, e.hinge_force + 14 * i);
        store_by_lane<12, sizeof(HingeRecord<T>) / sizeof(T)>(row, records[i].row);
    }
    return sum;
}

// ---- single vertices -----------------------------------------------------------------------------------------------------

// Upper triangles 00 01 02 11 12 22.
inline void add_outer(double* upper, double factor, const double* n) {
    int place = 0;
    for (int a = 0; a < 3; ++a)
        for (int b = a; b < 3; ++b) upper[place++] += factor * n[a] * n[b];
}

// Adds contact and friction at the position of a row of walls and grips; whether there is any. Set has the fields of Points.
template <class Set> inline bool add_contact(const Set& set, int64_t v, const double* pos, double* gradient, double* upper, double* indefinite_part) {
    bool any = false;
    for (int64_t w = 0; w < set.num_walls; ++w) {
        const Wall& wall = set.walls[w];
        const double depth = depth_of(wall, v, pos);
        if (!(depth > 0.0)) continue;
        const double weight = weight_of(wall, v), *normal = wall.normal + 3 * v;
        for (int k = 0; k < 3; ++k) gradient[k] -= contact_force(weight, depth) * normal[k];
        add_outer(upper, contact_curvature(weight, depth), normal);
        any = true;
    }
    for (int64_t w = 0; w < set.num_grips; ++w) {
        const Grip& grip = set.grips[w];
        const double force = grip.force[v];
        if (!(force > 0.0)) continue;
        any = true;
        double slip[3];
        const double *normal = grip.normal + 3 * v, limit = grip.limit[v], size = slip_of(grip, v, pos, slip);
        const double slope = slope_of(grip, v, size), along = friction_curvature(force, size, limit);
        for (int k = 0; k < 3; ++k) gradient[k] += slope * slip[k];
        upper[0] += slope, upper[3] += slope, upper[5] += slope;
        add_outer(upper, -slope, normal);
        if (size > 0.0) {
            const double heading[3] = {slip[0] / size, slip[1] / size, slip[2] / size};
            add_outer(indefinite_part, along - slope, heading);
        }
    }
    return any;
}

// The same of drag.
inline bool add_drag(const Points& set, int64_t i, const double* pos, double* gradient, double* upper) {
    for (int64_t w = 0; w < set.num_drags; ++w) {
        const Drag& drag = set.drags[w];
        double slip[3], across;
        const double *normal = drag.normal + 3 * i, size = drift_of(drag, i, pos, slip, &across);
        const double pressed = drag.across[i] * std::fabs(across), dragged = drag.along[i] * size;
        for (int k = 0; k < 3; ++k) gradient[k] += pressed * across * normal[k] + dragged * slip[k];
        upper[0] += dragged, upper[3] += dragged, upper[5] += dragged;
        add_outer(upper, 2.0 * pressed - dragged, normal);
        if (size > 0.0) add_outer(upper, dragged / (size * size), slip);
    }
    return set.num_drags > 0;
}

inline void vertex_model(const Engine& e, int64_t row, double* gradient, double* upper, double* indefinite_part) {
    const double *pos = e.pos + 4 * row, *acc = e.acc + 4 * row, *weight = e.weight + 3 * row;
    for (int k = 0; k < 3; ++k) gradient[k] = e.inertia[row] * acc[k] - weight[k];
    for (int k = 0; k < 6; ++k) upper[k] = indefinite_part[k] = 0.0;
    upper[0] = upper[3] = upper[5] = e.inertia[row] / e.dt_sq;
    add_contact(e, row, pos, gradient, upper, indefinite_part);
}

// ---- points inside edges and faces ---------------------------------------------------------------------------------------

inline void point_at(const Points& set, int64_t i, const double* pos, double* x) {
    for (int k = 0; k < 3; ++k) x[k] = 0.0;
    for (int c = 0; c < 3; ++c)
        for (int k = 0; k < 3; ++k) x[k] += set.weights[3 * i + c] * pos[4 * (int64_t)set.corners[3 * i + c] + k];
}

void point_models(const Points& set, const double* pos, Range range) {
    for (int64_t i = range.begin; i < range.end; ++i) {
        double x[3], *model = set.model + 16 * i;
        for (int k = 0; k < 16; ++k) model[k] = 0.0;
        point_at(set, i, pos, x);
        const bool touched = add_contact(set, i, x, model, model + 3, model + 9);
        model[15] = add_drag(set, i, x, model, model + 3) || touched;
    }
}

// Adds the gradient and the diagonal block that points bring to a row.
inline void add_points(const Engine& e, int64_t row, double* gradient, double* upper, double* indefinite_part) {
    for (int64_t s = 0; s < e.num_points; ++s) {
        const Points& set = e.points[s];
        for (int32_t i = set.starts[row]; i < set.starts[row + 1]; ++i) {
            const int32_t* use = set.uses + 5 * (int64_t)i;
            const double* model = set.model + 16 * (int64_t)use[0];
            if (model[15] == 0.0) continue;
            const double weight = set.weights[3 * (int64_t)use[0] + use[1]], square = weight * weight;
            for (int k = 0; k < 3; ++k) gradient[k] += weight * model[k];
            for (int k = 0; k < 6; ++k) upper[k] += square * model[3 + k], indefinite_part[k] += square * model[9 + k];
        }
    }
}

// What points bring to the blocks of a row beside its diagonal: add(place, factor, matrix, indefinite_part), upper triangles.
template <class Add> inline void couple_points(const Engine& e, int64_t row, const Add& add) {
    for (int64_t s = 0; s < e.num_points; ++s) {
        const Points& set = e.points[s];
        for (int32_t i = set.starts[row]; i < set.starts[row + 1]; ++i) {
            const int32_t* use = set.uses + 5 * (int64_t)i;
            const double *model = set.model + 16 * (int64_t)use[0], *weights = set.weights + 3 * (int64_t)use[0];
            if (model[15] == 0.0) continue;
            for (int c = 0; c < 3; ++c)
                if (use[2 + c] > 0) add(use[2 + c], weights[use[1]] * weights[c], model + 3, model + 9);
        }
    }
}

// ---- cloth near cloth ----------------------------------------------------------------------------------------------------

// Positions in the cloth's own numbering.
inline const double* own_order(const Engine& e, const double* pos, double* out) {
    for (int64_t i = 0; i < e.num_vertices; ++i)
        for (int k = 0; k < 3; ++k) out[3 * e.vertex_of_scene[i] + k] = pos[4 * i + k];
    return out;
}

// Whether anything is near anything at the state; then its forces, curvature and rows are those of the layers.
inline bool model_layers(const Engine& e) {
    return e.layers && e.layers->model(e.layers->layers, own_order(e, e.pos, e.layers->here)) > 0;
}

inline double energy_of_layers(const Engine& e, const double* pos) {
    return e.layers->energy(e.layers->layers, own_order(e, pos, e.layers->there));
}

inline bool near_layers(const Engine& e) { return e.layers && e.layers->num_contacts > 0; }

inline void add_layers(const Engine& e, int64_t row, double* gradient, double* upper) {
    const int64_t v = e.vertex_of_scene[row];
    for (int k = 0; k < 3; ++k) gradient[k] += e.layers->gradient[3 * v + k];
    for (int k = 0; k < 6; ++k) upper[k] += e.layers->own[6 * v + k];
}

inline const float* rows_of_layers(const LayerView& layers, float) { return layers.normals_single; }
inline const double* rows_of_layers(const LayerView& layers, double) { return layers.normals; }

inline void add_layer_grips(const Engine& e, int64_t row, double* gradient, double* upper, double* indefinite_part) {
    const LayerGrips& grips = *e.layer_grips;
    for (int k = 0; k < 3; ++k) gradient[k] += grips.gradient[3 * row + k];
    for (int k = 0; k < 6; ++k) upper[k] += grips.own[6 * row + k], indefinite_part[k] += grips.own_indefinite_part[6 * row + k];
}

inline void add_others(const OtherTerms& others, int64_t row, double* gradient, double* upper) {
    for (int k = 0; k < 3; ++k) gradient[k] += others.gradient[3 * row + k];
    for (int k = 0; k < 6; ++k) upper[k] += others.own[6 * row + k];
}

// Adds what the blocks beside the diagonal make of p to q.
template <class T> void couple_layers(const Engine& e) {
    typedef typename Four<T>::type V4;
    const T *p = (const T*)e.p, *normals = rows_of_layers(*e.layers, T());
    T* q = (T*)e.q;
    for (int64_t i = 0; i < e.layers->num_contacts; ++i) {
        const int32_t* row = e.layers->rows + 4 * i;
        V4 n[4];
        T along[4];
        for (int c = 0; c < 4; ++c) {
            n[c] = load<V4>(normals + 16 * i + 4 * c);
            const V4 product = n[c] * load<V4>(p + 4 * (int64_t)row[c]);
            along[c] = (product[0] + product[1]) + product[2];
        }
        const T total = (along[0] + along[1]) + (along[2] + along[3]);
        for (int c = 0; c < 4; ++c) {
            T* to = q + 4 * (int64_t)row[c];
            store(to, load<V4>(to) + (total - along[c]) * n[c]);
        }
    }
}

// ---- the potential -------------------------------------------------------------------------------------------------------

void place(const Engine& e, const double* acc, double* pos, Range rows) {
    for (int64_t row = rows.begin; row < rows.end; ++row) {
        const double* base = e.base + 3 * row;
        for (int k = 0; k < 3; ++k) pos[4 * row + k] = base[k] + e.dt_sq * acc[4 * row + k];
    }
}

void place(const Engine& e, const double* acc, double* pos) { place(e, acc, pos, {0, e.num_rows}); }

// Energies of some vertices: of inertia, of gravity, of every wall and of every grip.
void vertex_energies(const Engine& e, const double* pos, const double* acc, Range rows, double* sums) {
    double inertia = 0.0, gravity = 0.0;
    for (int64_t row = rows.begin; row < rows.end; ++row) {
        gravity -= dot3(e.weight + 3 * row, pos + 4 * row);
        if (row < e.num_rows) {
            inertia += 0.5 * e.inertia[row] * e.dt_sq * dot3(acc + 4 * row, acc + 4 * row);
            continue;
        }
        double moved[3];
        for (int k = 0; k < 3; ++k) moved[k] = pos[4 * row + k] - e.base[3 * row + k];
        inertia += 0.5 * e.inertia[row] / e.dt_sq * dot3(moved, moved);
    }
    *sums++ = inertia, *sums++ = gravity;
    const auto put = [&](const auto& of_row) {
        double sum = 0.0;
        for (int64_t row = rows.begin; row < rows.end; ++row) sum += of_row(row);
        *sums++ = sum;
    };
    for (int64_t w = 0; w < e.num_walls; ++w) put([&](int64_t row) { return wall_energy(e.walls[w], row, pos + 4 * row); });
    for (int64_t w = 0; w < e.num_grips; ++w) put([&](int64_t row) { return grip_energy(e.grips[w], row, pos + 4 * row); });
}

// Potential at a placed state, and the rounding it is known to; with the elements' models there, which cost little more.
void energy(const Engine& e, const double* pos, const double* acc, bool model, double* phi, double* noise) {
    double sum = 0.0, size = 0.0;
    const auto add = [&](double part) { sum += part, size += std::fabs(part); };
    const int64_t terms = 2 + e.num_walls + e.num_grips, stride = (terms + 15) / 8 * 8;  // a line of the cache apart
    std::vector<double> vertices(stride * e.parts);
    Sums<double> faces, hinges;
    for_parts(e.parts, [&](int64_t part) {
        vertex_energies(e, pos, acc, range_of(e.num_vertices, part, e.parts), vertices.data() + stride * part);
        const auto face_sum = model ? face_models<Real> : e.weave ? face_energy<weave_of> : face_energy<isotropic_of>;
        if (e.membrane) faces[part] = face_sum(e, pos, faces_of(e, part));
        if (e.bending) hinges[part] = (model ? hinge_models<Real> : hinge_energy)(e, pos, hinges_of(e, part));
    });
    for (int64_t term = 0; term < terms; ++term) {
        double whole = vertices[term];
        for (int64_t part = 1; part < e.parts; ++part) whole += vertices[stride * part + term];
        add(whole);
    }
    for (int64_t s = 0; s < e.num_points; ++s) {
        const Points& set = e.points[s];
        double x[3];
        for (int64_t w = 0; w < set.num_walls + set.num_grips; ++w) {
            double part = 0.0;
            for (int64_t i = 0; i < set.count; ++i) {
                point_at(set, i, pos, x);
                part += w < set.num_walls ? wall_energy(set.walls[w], i, x) : grip_energy(set.grips[w - set.num_walls], i, x);
            }
            add(part);
        }
        for (int64_t w = 0; w < set.num_drags; ++w) {
            double part = 0.0;
            for (int64_t i = 0; i < set.count; ++i) {
                point_at(set, i, pos, x);
                part += drag_energy(set.drags[w], i, x);
            }
            add(part);
        }
    }
    if (e.membrane) add(faces.total(e.parts));
    if (e.bending) add(hinges.total(e.parts));
    double springs = 0.0;
    for (int64_t s = 0; s < e.num_springs; ++s) {
        double gap[3];
        for (int k = 0; k < 3; ++k) {
            gap[k] = pos[4 * e.spring_ends[s] + k] - pos[4 * e.spring_ends[e.num_springs + s] + k] - e.spring_target[4 * s + k];
        }
        springs += 0.5 * e.spring_stiffness[s] * dot3(gap, gap);
    }
    if (e.num_springs) add(springs);
    if (e.layers) add(energy_of_layers(e, pos));
    if (e.layer_grips) add(layer_grip_energy(*e.layer_grips, pos));
    if (e.others) add(e.others->energy(pos));
    *phi = sum;
    *noise = 8.0 * 2.220446049250313e-16 * size;
}

// ---- the matrix ----------------------------------------------------------------------------------------------------------

constexpr int PAIR[3][3] = {{0, 1, 2}, {1, 3, 4}, {2, 4, 5}};

template <int CORNERS> inline D4 pull_of(const double* forces, int size, const int32_t* starts, const int32_t* uses, int64_t row) {
    D4 sum = D4{};
    for (int64_t i = starts[CORNERS * row]; i < starts[CORNERS * (row + 1)]; ++i) {
        const int32_t use = uses[(1 + CORNERS) * i];
        sum += load<D4>(forces + size * (int64_t)(use >> 2) + 3 * (use & 3));
    }
    return sum;
}

// The gradient, and the blocks of single vertices; the elements' forces have been made.
template <class T> void gather_gradient(const Engine& e, Range range, bool near) {
    T *own = (T*)e.own, *own_indefinite_part = (T*)e.own_indefinite_part;
    for (int64_t row = range.begin; row < range.end; ++row) {
        double gradient[3], upper[6], indefinite_part[6];
        vertex_model(e, row, gradient, upper, indefinite_part);
        add_points(e, row, gradient, upper, indefinite_part);
        if (near) add_layers(e, row, gradient, upper);
        if (e.layer_grips) add_layer_grips(e, row, gradient, upper, indefinite_part);
        if (e.others) add_others(*e.others, row, gradient, upper);
        D4 force = D4{gradient[0], gradient[1], gradient[2], 0.0};
        if (e.membrane) force += pull_of<3>(e.face_force, 10, e.face_starts, e.face_uses, row);
        if (e.bending) force += pull_of<4>(e.hinge_force, 14, e.hinge_starts, e.hinge_uses, row);
        for (int64_t i = e.spring_starts[2 * row]; i < e.spring_starts[2 * (row + 1)]; ++i) {
            const int64_t spring = e.spring_uses[3 * i] >> 2, corner = e.spring_uses[3 * i] & 3;
            const int64_t here = e.spring_ends[corner * e.num_springs + spring];
            const int64_t there = e.spring_ends[(1 - corner) * e.num_springs + spring];
            const D4 gap = load<D4>(e.pos + 4 * here) - load<D4>(e.pos + 4 * there), target = load<D4>(e.spring_target + 4 * spring);
            force += e.spring_stiffness[spring] * (corner == 0 ? gap - target : gap + target);
        }
        store(e.gradient + 4 * row, D4{force[0], force[1], force[2], 0.0});
        for (int k = 0; k < 6; ++k) own[6 * row + k] = (T)upper[k], own_indefinite_part[6 * row + k] = (T)indefinite_part[k];
    }
}

template <class T> struct Row {
    typedef typename Four<T>::type V4;
    V4 *axial, *block;  // of every block what is added to its diagonal and the indefinite part of that, and its three rows
    V4 own_axial, own[3];  // the same of the block on the diagonal: all elements add to it, and memory would be waited for
};

// Faces with as many BLOCKS in the row, the first on its diagonal.
template <class T, int BLOCKS> inline void add_faces(const Engine& e, int64_t from, int64_t to, Row<T>& row) {
    typedef typename Four<T>::type V4;
    for (int64_t i = from; i < to; ++i) {
        const int32_t* use = e.face_uses + 4 * i;
        const FaceRecord<T>& face = ((const FaceRecord<T>*)e.face_model)[use[0] >> 2];
        const int c = use[0] & 3;
        const T* own = face.root + 3 * c;
        const auto add = [&](int d, V4* target, V4& axial) {
            const T* other = face.root + 3 * d;
            const V4 first = load<V4>(other), second = load<V4>(other + 9), third = load<V4>(other + 18);
            for (int k = 0; k < 3; ++k) target[k] += own[k] * first + own[9 + k] * second + own[18 + k] * third;
            axial += load<V4>(face.axial + 2 * PAIR[c][d]);
        };
        add(c, row.own, row.own_axial);
        for (int b = 1; b < BLOCKS; ++b) {
            const int64_t place = use[1 + b] >> 2;
            add(use[1 + b] & 3, row.block + 3 * place, row.axial[place]);
        }
    }
}

template <class T, int BLOCKS> inline void add_hinges(const Engine& e, int64_t from, int64_t to, Row<T>& row) {
    typedef typename Four<T>::type V4;
    for (int64_t i = from; i < to; ++i) {
        const int32_t* use = e.hinge_uses + 5 * i;
        const HingeRecord<T>& hinge = ((const HingeRecord<T>*)e.hinge_model)[use[0] >> 2];
        const T* own = hinge.row + 3 * (use[0] & 3);
        const auto add = [&](int d, V4* target) {
            const V4 other = load<V4>(hinge.row + 3 * d);
            for (int k = 0; k < 3; ++k) target[k] += own[k] * other;
        };
        add(use[0] & 3, row.own);
        for (int b = 1; b < BLOCKS; ++b) add(use[1 + b] & 3, row.block + 3 * (int64_t)(use[1 + b] >> 2));
    }
}

// Where the first block of a row is in the matrix, and its own block in arrays of one block a row.
template <class T> inline T* blocks_of(const Engine& e, T* matrix, int64_t row) {
    return matrix + 24 * (int64_t)e.pair_starts[e.slot[row] >> 1] + 4 * (e.slot[row] & 1);
}
template <class T> inline T* own_block(const Engine& e, T* blocks, int64_t row) { return blocks + 24 * (int64_t)(e.slot[row] >> 1) + 4 * (e.slot[row] & 1); }

// The inverse ones of the symmetric blocks of rows, by cofactors, scaled to a diagonal of ones first; many rows at a time.
template <class T> void invert_blocks(const Engine& e, Range range) {
    constexpr int AXES[6][2] = {{0, 0}, {0, 1}, {0, 2}, {1, 1}, {1, 2}, {2, 2}};
    for (int64_t row = range.begin; row < range.end; row += AT_ONCE) {
        const T* block[AT_ONCE];
        T* inverse[AT_ONCE];
        for (int lane = 0; lane < AT_ONCE; ++lane) {
            const int64_t at = std::min(row + lane, range.end - 1);
            block[lane] = own_block(e, (const T*)e.block, at), inverse[lane] = own_block(e, (T*)e.inverse, at);
        }
        VN m[6], a[6], scale[3];
        for (int k = 0; k < 6; ++k) m[k] = gather([&](int lane) { return (double)block[lane][8 * AXES[k][0] + AXES[k][1]]; });
        for (int i = 0; i < 3; ++i) {
            const VN own = m[PAIR[i][i]];
            scale[i] = 1.0 / root(own > 0.0 ? own : every(2.2250738585072014e-308));
        }
        for (int k = 0; k < 6; ++k) a[k] = m[k] * scale[AXES[k][0]] * scale[AXES[k][1]];
        VN c[6] = {a[3] * a[5] - a[4] * a[4], a[2] * a[4] - a[1] * a[5], a[1] * a[4] - a[2] * a[3],
                   a[0] * a[5] - a[2] * a[2], a[1] * a[2] - a[0] * a[4], a[0] * a[3] - a[1] * a[1]};
        VN determinant = a[0] * c[0] + a[1] * c[1] + a[2] * c[2];
        determinant = determinant > 2.220446049250313e-16 ? determinant : every(2.220446049250313e-16);
        for (int k = 0; k < 6; ++k) c[k] = c[k] / determinant * scale[AXES[k][0]] * scale[AXES[k][1]];
        for (int lane = 0; lane < AT_ONCE; ++lane)
            for (int i = 0; i < 3; ++i)
                store(inverse[lane] + 8 * i, typename Four<T>::type{(T)c[PAIR[i][0]][lane], (T)c[PAIR[i][1]][lane], (T)c[PAIR[i][2]][lane], T(0)});
    }
}

// The upper rows of blocks, with a share of the indefinite part, and the inverse diagonal blocks of the matrix without it.
template <class T> void gather_matrix(const Engine& e, int64_t part) {
    typedef typename Four<T>::type V4;
    T *matrix = (T*)e.matrix, *indefinite_part = (T*)e.indefinite_part, *block = (T*)e.block;
    const T indefinite_share = (T)e.indefinite_share;
    const V4 unit[3] = {V4{1, 0, 0, 0}, V4{0, 1, 0, 0}, V4{0, 0, 1, 0}};
    V4* memory = (V4*)e.row_sum + 4 * e.most_blocks * part;
    Row<T> sum = {memory, memory + e.most_blocks, V4{}, {}};
    for (int64_t i = 0; i < 4 * e.most_blocks; ++i) memory[i] = V4{};
    const Range range = rows_of(e, part);
    for (int64_t row = range.begin; row < range.end; ++row) {
        const int64_t start = e.row_starts[row], degree = e.row_starts[row + 1] - start;
        const T *own = (const T*)e.own + 6 * row, *own_indefinite_part = (const T*)e.own_indefinite_part + 6 * row;
        for (int k = 0; k < 3; ++k) sum.own[k] = V4{own[PAIR[k][0]], own[PAIR[k][1]], own[PAIR[k][2]], T(0)};
        sum.own_axial = V4{};
        if (e.membrane) {
            const int32_t* starts = e.face_starts + 3 * row;
            add_faces<T, 3>(e, starts[0], starts[1], sum);
            add_faces<T, 2>(e, starts[1], starts[2], sum);
            add_faces<T, 1>(e, starts[2], starts[3], sum);
        }
        if (e.bending) {
            const int32_t* starts = e.hinge_starts + 4 * row;
            add_hinges<T, 4>(e, starts[0], starts[1], sum);
            add_hinges<T, 3>(e, starts[1], starts[2], sum);
            add_hinges<T, 2>(e, starts[2], starts[3], sum);
            add_hinges<T, 1>(e, starts[3], starts[4], sum);
        }
        for (int64_t i = e.spring_starts[2 * row]; i < e.spring_starts[2 * (row + 1)]; ++i) {
            const int32_t* use = e.spring_uses + 3 * i;
            const T stiffness = (T)e.spring_stiffness[use[0] >> 2];
            sum.own_axial += V4{stiffness, T(0), T(0), T(0)};
            if (i < e.spring_starts[2 * row + 1]) sum.axial[use[2] >> 2] += V4{-stiffness, T(0), T(0), T(0)};
        }
        couple_points(e, row, [&](int32_t place, double factor, const double* m, const double* less) {
            for (int k = 0; k < 3; ++k)
                for (int j = 0; j < 3; ++j)
                    sum.block[3 * place + k][j] += (T)(factor * (m[PAIR[k][j]] + e.indefinite_share * less[PAIR[k][j]]));
        });
        for (int k = 0; k < 3; ++k) sum.own[k] += sum.own_axial[0] * unit[k];
        for (int k = 0; k < 3; ++k) store(own_block(e, block, row) + 8 * k, sum.own[k]);
        T* target = blocks_of(e, matrix, row);
        const T axial = indefinite_share * sum.own_axial[1];
        for (int k = 0; k < 3; ++k) {
            const V4 less = {own_indefinite_part[PAIR[k][0]], own_indefinite_part[PAIR[k][1]], own_indefinite_part[PAIR[k][2]], T(0)};
            store(target + 8 * k, sum.own[k] + indefinite_share * less + axial * unit[k]);
        }
        indefinite_part[start] = sum.own_axial[1];
        for (int64_t i = 1; i < degree; ++i) {
            target += 24;
            const T axial = sum.axial[i][0] + indefinite_share * sum.axial[i][1];
            for (int k = 0; k < 3; ++k) store(target + 8 * k, sum.block[3 * i + k] + axial * unit[k]), sum.block[3 * i + k] = V4{};
            indefinite_part[start + i] = sum.axial[i][1], sum.axial[i] = V4{};
        }
    }
    invert_blocks<T>(e, range);
}

template <class T> void gather_matrix(const Engine& e) {
    for_parts(e.parts, [&](int64_t part) { gather_matrix<T>(e, part); });
}

template <class T> void differentiate(Engine& e) {
    for_parts(e.parts, [&](int64_t part) {
        if (e.membrane && !e.modelled) face_models<T>(e, e.pos, faces_of(e, part));
        if (e.bending && !e.modelled) hinge_models<T>(e, e.pos, hinges_of(e, part));
        for (int64_t s = 0; s < e.num_points; ++s) point_models(e.points[s], e.pos, range_of(e.points[s].count, part, e.parts));
    });
    e.modelled = true;
    const bool near = model_layers(e);
    if (e.layer_grips) model_layer_grips(*e.layer_grips, e.num_vertices, e.pos);
    if (e.others) e.others->model(e.pos);
    for_parts(e.parts, [&](int64_t part) { gather_gradient<T>(e, rows_of(e, part), near); });
}

// The share of the indefinite part that is in the matrix, from what it was to what it shall be.
template <class T> void sharpen(Engine& e, double indefinite_share) {
    T *matrix = (T*)e.matrix, *indefinite_part = (T*)e.indefinite_part, *own_indefinite_part = (T*)e.own_indefinite_part;
    const T change = (T)(indefinite_share - e.indefinite_share);
    e.indefinite_share = indefinite_share;
    if (change == T(0)) return;
    for_parts(e.parts, [&](int64_t part) {
        const Range range = rows_of(e, part);
        for (int64_t row = range.begin; row < range.end; ++row) {
            T* block = blocks_of(e, matrix, row);
            for (int64_t i = e.row_starts[row]; i < e.row_starts[row + 1]; ++i, block += 24)
                for (int k = 0; k < 3; ++k) block[9 * k] += change * indefinite_part[i];
        }
        if (e.num_grips || e.num_points || e.layer_grips)
            for (int64_t row = range.begin; row < range.end; ++row)
                for (int a = 0; a < 3; ++a)
                    for (int b = 0; b < 3; ++b)
                        blocks_of(e, matrix, row)[8 * a + b] += change * own_indefinite_part[6 * row + PAIR[a][b]];
        for (int64_t row = range.begin; row < range.end && e.num_points; ++row)
            couple_points(e, row, [&](int32_t place, double factor, const double*, const double* less) {
                T* block = blocks_of(e, matrix, row) + 24 * (int64_t)place;
                for (int a = 0; a < 3; ++a)
                    for (int b = 0; b < 3; ++b) block[8 * a + b] += change * (T)(factor * less[PAIR[a][b]]);
            });
    });
}

// ---- the linear system ---------------------------------------------------------------------------------------------------
//
// Conjugate gradients with a symmetric Gauss-Seidel sweep as preconditioner, M = (B + L) B^-1 (B + U): B the diagonal blocks
// without their indefinite part, which are positive, L and U the blocks below and above. In the variables r' = (B + L)^-1 r and
// p' = (B + U) p the matrix is H' p' = p + (B + L)^-1 ((D - B) p + U p) with the diagonal blocks D that it has, and the
// preconditioner B (Eisenstat 1981): an iteration goes through the blocks once backwards and once forwards, and there is no
// product with H beside. Threads sweep over parts of their own; what couples the parts, and cloth with near cloth, is in H alone.

template <class T, class V8> inline V8 by_block(const T* m, V8 v) {
    return load<V8>(m) * spread<0>(v) + load<V8>(m + 8) * spread<1>(v) + load<V8>(m + 16) * spread<2>(v);
}

// Adds the products of the first numbers of a pair, then those of the second.
template <class V8> inline void add_product(D4& sum, V8 a, V8 b) {
    const V8 product = a * b;
    sum += __builtin_convertvector(first_of(product), D4);
    sum += __builtin_convertvector(second_of(product), D4);
}

// p' = z + share p', p from it, and (D - B) p + U p in the place of z, of some pairs of a part that ends at a slot.
template <class T, bool INSIDE> inline void sweep_back(const Engine& e, Range range, int64_t end, T share) {
    typedef typename Four<T>::type V4;
    typedef typename Pair<T>::type V8;
    const T *matrix = (const T*)e.matrix, *inverse = (const T*)e.inverse;
    T *p = (T*)e.p, *q = (T*)e.q, *turned = (T*)e.z;
    const int32_t *cols = e.pair_cols, *starts = e.pair_starts;
    const V4 none = V4{};
    for (int64_t pair = range.end - 1; pair >= range.begin; --pair) {
        const V8 along = load<V8>(q + 8 * pair) + share * load<V8>(turned + 8 * pair);
        store(turned + 8 * pair, along);
        V8 a = V8{}, b = V8{}, c = V8{};
        const int64_t first = starts[pair];
        const T *own = matrix + 24 * first, *m = matrix + 24 * (int64_t)starts[pair + 1];
#pragma GCC unroll 4
        for (const int32_t* col = cols + 2 * (int64_t)starts[pair + 1] - 2; col > cols + 2 * first; col -= 2) {
            m -= 24;
            const T *one = p + 4 * (int64_t)col[0], *two = p + 4 * (int64_t)col[1];
            if (!INSIDE) one = col[0] < end ? one : (const T*)&none, two = col[1] < end ? two : (const T*)&none;
            const V8 other = load_both(one, two);
            a = a + load<V8>(m) * other, b = b + load<V8>(m + 8) * other, c = c + load<V8>(m + 16) * other;
        }
        const V8 above = sum_axes(a, b, c), rest = along - above;
        const V8 step = by_block<T>(inverse + 24 * pair, rest);
        store(p + 8 * pair, step);
        store(q + 8 * pair, by_block<T>(own, step) + above - rest);
    }
}

// q = p + (B + L)^-1 q of a part; their p' . q.
template <class T, bool FROM_ZERO, bool INSIDE> inline D4 sweep_on(const Engine& e, Range range) {
    typedef typename Four<T>::type V4;
    typedef typename Pair<T>::type V8;
    const T *matrix = (const T*)e.matrix, *inverse = (const T*)e.inverse, *p = (const T*)e.p, *turned = (const T*)e.z;
    T* q = (T*)e.q;
    const int32_t *cols = e.pair_cols, *starts = e.pair_starts;
    D4 sum = D4{};
    const auto take = [&](int32_t col, V4 less) {
        if (!INSIDE && col >= 2 * range.end) return;
        T* target = q + 4 * (int64_t)col;
        store(target, load<V4>(target) - less);
    };
    for (int64_t pair = range.begin; pair < range.end; ++pair) {
        const V8 step = by_block<T>(inverse + 24 * pair, load<V8>(q + 8 * pair));
        const V8 x = spread<0>(step), y = spread<1>(step), z = spread<2>(step);
        const T* m = matrix + 24 * (int64_t)starts[pair];
        const int32_t* end = cols + 2 * (int64_t)starts[pair + 1];
#pragma GCC unroll 4
        for (const int32_t* col = cols + 2 * (int64_t)starts[pair] + 2; col < end; col += 2) {
            m += 24;
            const V8 less = load<V8>(m) * x + load<V8>(m + 8) * y + load<V8>(m + 16) * z;
            take(col[0], first_of(less));
            take(col[1], second_of(less));
        }
        const V8 product = FROM_ZERO ? step : load<V8>(p + 8 * pair) + step;
        store(q + 8 * pair, product);
        if (!FROM_ZERO) add_product(sum, product, load<V8>(turned + 8 * pair));
    }
    return sum;
}

template <class T, bool FROM_ZERO> inline D4 sweep_on(const Engine& e, Range range) {
    return range.end == e.num_pairs ? sweep_on<T, FROM_ZERO, true>(e, range) : sweep_on<T, FROM_ZERO, false>(e, range);
}

template <class T> void sweep_back(const Engine& e, int64_t part, T share) {
    const Range range = pairs_of(e, part);
    const int64_t inside = e.parts == 1 ? range.end : std::max(range.begin, range.end - e.reach);
    sweep_back<T, false>(e, {inside, range.end}, 2 * range.end, share);
    sweep_back<T, true>(e, {range.begin, inside}, 2 * range.end, share);
}

// Adds to q of a part what the blocks between it and other parts make of p.
template <class T> void couple_part(const Engine& e, int64_t part) {
    typedef typename Four<T>::type V4;
    T* q = (T*)e.q;
    const T *p = (const T*)e.p, *matrix = (const T*)e.matrix;
    const int32_t *starts = e.outer_starts + 2 * part, *outer = e.outer_blocks + 3 * (int64_t)starts[0];
    for (int64_t i = starts[0]; i < starts[1]; ++i, outer += 3) {
        const V4 other = load<V4>(p + 4 * (int64_t)outer[1]);
        const T* m = matrix + outer[2];
        T* own = q + 4 * (int64_t)outer[0];
        store(own, load<V4>(own) + load<V4>(m) * other[0] + load<V4>(m + 8) * other[1] + load<V4>(m + 16) * other[2]);
    }
    for (int64_t i = starts[1]; i < starts[2]; ++i, outer += 3) {
        const V4 other = load<V4>(p + 4 * (int64_t)outer[1]);
        const T* m = matrix + outer[2];
        const V4 a = load<V4>(m) * other, b = load<V4>(m + 8) * other, c = load<V4>(m + 16) * other;
        T* own = q + 4 * (int64_t)outer[0];
        store(own, load<V4>(own) + V4{a[0] + a[1] + a[2], b[0] + b[1] + b[2], c[0] + c[1] + c[2], T(0)});
    }
}

// z = B r of a pair, in the place of q; adds r . z.
template <class T, class V8> inline void precondition(const Engine& e, int64_t pair, V8 left, D4& sum) {
    const V8 result = by_block<T>((const T*)e.block + 24 * pair, left);
    store((T*)e.q + 8 * pair, result);
    add_product(sum, result, left);
}

// The vectors of conjugate gradients where they begin, with x = 0; r . z of a part.
template <class T> D4 begin_pairs(const Engine& e, int64_t part, double scale) {
    typedef typename Four<T>::type V4;
    typedef typename Pair<T>::type V8;
    const Range range = pairs_of(e, part);
    const int64_t first = 8 * range.begin, size = sizeof(T) * 8 * (range.end - range.begin);
    for (void* vector : {e.x, e.z, e.p}) std::memset((T*)vector + first, 0, size);
    for (int64_t slot = 2 * range.begin; slot < 2 * range.end; ++slot) {
        const int64_t row = e.row_of_slot[slot];
        store((T*)e.q + 4 * slot, row < 0 ? V4{} : __builtin_convertvector(-scale * load<D4>(e.gradient + 4 * row), V4));
    }
    sweep_on<T, true>(e, range);
    std::memcpy((T*)e.r + first, (T*)e.q + first, size);
    D4 sum = D4{};
    for (int64_t pair = range.begin; pair < range.end; ++pair) precondition<T>(e, pair, load<V8>((T*)e.r + 8 * pair), sum);
    return sum;
}

// A step along p; r . z of a part.
template <class T> D4 step_pairs(const Engine& e, int64_t part, T length) {
    typedef typename Pair<T>::type V8;
    T *x = (T*)e.x, *r = (T*)e.r;
    const T *p = (const T*)e.p, *q = (const T*)e.q;
    const Range range = pairs_of(e, part);
    D4 sum = D4{};
    for (int64_t pair = range.begin; pair < range.end; ++pair) {
        const V8 left = load<V8>(r + 8 * pair) - length * load<V8>(q + 8 * pair);
        store(x + 8 * pair, load<V8>(x + 8 * pair) + length * load<V8>(p + 8 * pair));
        store(r + 8 * pair, left);
        precondition<T>(e, pair, left, sum);
    }
    return sum;
}

// The sum over the parts, and then over the axes.
template <class Compute> inline double sum_parts(const Engine& e, const Compute& compute) {
    Sums<D4> sums;
    for_parts(e.parts, [&](int64_t part) { sums[part] = compute(part); });
    const D4 sum = sums.total(e.parts);
    return (sum[0] + sum[1]) + sum[2];
}

// Adds to q what cloth near cloth makes of p beside the blocks.
template <class T> void couple_cloth(const Engine& e) {
    if (near_layers(e)) couple_layers<T>(e);
    if (e.layer_grips) couple_layer_grips<T>(*e.layer_grips, e.num_rows, e.slot, e.indefinite_share, (const T*)e.p, (T*)e.q);
}

// q = H' p' for p' = z + share p'; their product.
template <class T> double multiply(const Engine& e, T share) {
    for_parts(e.parts, [&](int64_t part) { sweep_back<T>(e, part, share); });
    couple_cloth<T>(e);
    return sum_parts(e, [&](int64_t part) {
        if (e.parts > 1) couple_part<T>(e, part);
        return sweep_on<T, false>(e, pairs_of(e, part));
    });
}

// What the right-hand side is multiplied by: its norm becomes 1, nothing overflows in float32.
inline double right_scale(const Engine& e) {
    double norm = 0.0;
    for (int64_t row = 0; row < e.num_rows; ++row) norm += dot3(e.gradient + 4 * row, e.gradient + 4 * row);
    return norm > 0.0 ? 1.0 / std::sqrt(norm) : 0.0;
}

template <class T> void read_direction(const Engine& e, double scale) {
    const T* x = (const T*)e.x;
    const double size = scale > 0.0 ? 1.0 / scale : 0.0;
    for (int64_t row = 0; row < e.num_rows; ++row)
        for (int k = 0; k < 3; ++k) e.direction[4 * row + k] = size * (double)x[4 * (int64_t)e.slot[row] + k];
}

// Larger blocks of the diagonal in the preconditioner where parts meet, as long as this lives. Sweeps leave out what acts between
// parts: the preconditioned matrix has eigenvalues of up to 2 instead of 1, and two parts take 1.4 times as many iterations as one.
// With blocks larger by twice the share that is left out they take 1.0 to 1.1 times as many (Baker et al. 2011 add the l1 norm of what
// is left out; a share of the block itself stays soft across the cloth). See benchmarks/preconditioners.py --parts.
template <class T> struct LargerBlocks {
    const Engine& e;
    T* const before;  // what they were, and their inverse ones

    explicit LargerBlocks(const Engine& engine) : e(engine), before((T*)e.border_blocks) {
        for (int64_t i = 0; i < e.num_border; ++i) {
            const double factor = 1.0 + 2.0 * e.outside[i];
            for (int k = 0; k < 12; ++k) {
                T &block = at((T*)e.block, i, k), &inverse = at((T*)e.inverse, i, k);
                before[24 * i + k] = block, before[24 * i + 12 + k] = inverse;
                block *= (T)factor, inverse *= (T)(1.0 / factor);
            }
        }
    }
    ~LargerBlocks() {
        for (int64_t i = 0; i < e.num_border; ++i)
            for (int k = 0; k < 12; ++k) at((T*)e.block, i, k) = before[24 * i + k], at((T*)e.inverse, i, k) = before[24 * i + 12 + k];
    }
    T& at(T* blocks, int64_t i, int k) const { return own_block(e, blocks, e.border[i])[8 * (k / 4) + k % 4]; }
};

// Conjugate gradients for the direction; false where the matrix turned out not to be positive definite.
template <class T> bool solve(Engine& e, double tolerance, int64_t most) {
    const double scale = right_scale(e);
    const LargerBlocks<T> larger(e);
    double rz = sum_parts(e, [&](int64_t part) { return begin_pairs<T>(e, part, scale); });
    const double limit = tolerance * tolerance * rz;
    T share = T(0);
    bool definite = true;
    for (int64_t iteration = 0; iteration < most && rz > limit; ++iteration) {
        const double curvature = multiply<T>(e, share);
        if (!(curvature > 0.0)) {
            definite = false;
            break;
        }
        const T length = (T)(rz / curvature);
        const double before = rz;
        rz = sum_parts(e, [&](int64_t part) { return step_pairs<T>(e, part, length); });
        share = (T)(rz / before);
        ++e.cg_used;
    }
    read_direction<T>(e, scale);
    return definite;
}

// q = H p of a part, without what couples it to other parts.
template <class T> void multiply_part(const Engine& e, Range range) {
    typedef typename Four<T>::type V4;
    typedef typename Pair<T>::type V8;
    const T *p = (const T*)e.p, *matrix = (const T*)e.matrix;
    T* q = (T*)e.q;
    std::memset(q + 8 * range.begin, 0, sizeof(T) * 8 * (range.end - range.begin));
    for (int64_t pair = range.begin; pair < range.end; ++pair) {
        const T* m = matrix + 24 * (int64_t)e.pair_starts[pair];
        const V8 own = load<V8>(p + 8 * pair), x = spread<0>(own), y = spread<1>(own), z = spread<2>(own);
        V8 a = load<V8>(m) * own, b = load<V8>(m + 8) * own, c = load<V8>(m + 16) * own;
        for (int64_t i = e.pair_starts[pair] + 1; i < e.pair_starts[pair + 1]; ++i) {
            m += 24;
            const V8 first = load<V8>(m), second = load<V8>(m + 8), third = load<V8>(m + 16), more = first * x + second * y + third * z;
            const V4 halves[2] = {first_of(more), second_of(more)}, none = V4{};
            const T* other[2];
            for (int half = 0; half < 2; ++half) {
                const int64_t col = e.pair_cols[2 * i + half];
                other[half] = col < 2 * range.end ? p + 4 * col : (const T*)&none;
                if (col < 2 * range.end) store(q + 4 * col, load<V4>(q + 4 * col) + halves[half]);
            }
            const V8 both = load_both(other[0], other[1]);
            a = a + first * both, b = b + second * both, c = c + third * both;
        }
        store(q + 8 * pair, load<V8>(q + 8 * pair) + sum_axes(a, b, c));
    }
}

// So many iterations with the blocks of the diagonal as preconditioner, as hood.solver.vertex.cg_step: networks are trained with
// what so many lead to.
template <class T> void solve_by_blocks(Engine& e, int64_t most) {
    typedef typename Four<T>::type V4;
    typedef typename Pair<T>::type V8;
    T *x = (T*)e.x, *r = (T*)e.r, *z = (T*)e.z, *p = (T*)e.p, *q = (T*)e.q;
    const double scale = right_scale(e);
    const auto sum_pairs = [&](const auto& add) {
        return sum_parts(e, [&](int64_t part) {
            D4 sum = D4{};
            const Range range = pairs_of(e, part);
            for (int64_t pair = range.begin; pair < range.end; ++pair) add(pair, sum);
            return sum;
        });
    };
    const auto precondition = [&](int64_t pair, V8 left, D4& sum) {
        const V8 result = by_block<T>((const T*)e.inverse + 24 * pair, left);
        store(r + 8 * pair, left), store(z + 8 * pair, result);
        add_product(sum, result, left);
    };
    double rz = sum_pairs([&](int64_t pair, D4& sum) {
        for (int64_t slot = 2 * pair; slot < 2 * pair + 2; ++slot) {
            const int64_t row = e.row_of_slot[slot];
            store(r + 4 * slot, row < 0 ? V4{} : __builtin_convertvector(-scale * load<D4>(e.gradient + 4 * row), V4));
        }
        precondition(pair, load<V8>(r + 8 * pair), sum);
        store(x + 8 * pair, V8{}), store(p + 8 * pair, load<V8>(z + 8 * pair));
    });
    for (int64_t iteration = 0; iteration < most && rz > 0.0; ++iteration) {
        for_parts(e.parts, [&](int64_t part) { multiply_part<T>(e, pairs_of(e, part)); });
        couple_cloth<T>(e);
        if (e.parts > 1) for_parts(e.parts, [&](int64_t part) { couple_part<T>(e, part); });
        const double curvature = sum_pairs([&](int64_t pair, D4& sum) { add_product(sum, load<V8>(p + 8 * pair), load<V8>(q + 8 * pair)); });
        if (!(curvature > 0.0)) break;
        const T length = (T)(rz / curvature);
        const double before = rz;
        rz = sum_pairs([&](int64_t pair, D4& sum) {
            store(x + 8 * pair, load<V8>(x + 8 * pair) + length * load<V8>(p + 8 * pair));
            precondition(pair, load<V8>(r + 8 * pair) - length * load<V8>(q + 8 * pair), sum);
        });
        const T share = (T)(rz / before);
        sum_pairs([&](int64_t pair, D4&) { store(p + 8 * pair, load<V8>(z + 8 * pair) + share * load<V8>(p + 8 * pair)); });
        ++e.cg_used;
    }
    read_direction<T>(e, scale);
}

// As much of the indefinite part as the system bears, see hood.solver.system.linear.Directions.
template <class T> void direct(Engine& e, double tolerance, int64_t most) {
    e.indefinite_share = e.raised;
    gather_matrix<T>(e);
    double indefinite_share = e.raised;
    bool halved = false;
    while (true) {
        sharpen<T>(e, indefinite_share);
        if (solve<T>(e, tolerance, most) || !(indefinite_share > 0.0)) break;
        indefinite_share = indefinite_share > 0.2 ? 0.5 * indefinite_share : 0.0;
        halved = true;
    }
    const double raised = 2.0 * indefinite_share;
    e.raised = halved ? indefinite_share : raised < 0.1 ? 0.1 : raised > 1.0 ? 1.0 : raised;
}

// ---- the Hessian itself, for derivatives of the minimum --------------------------------------------------------------------

// What Gauss-Newton leaves out of bending about the rest shape, force times the second derivative of the angle: blocks of the corners
// 00 01 02 03 11 12 13 22 23 33, (H, 10, 9).
template <class T> void hinge_curvatures(const Engine& e, T* blocks, Range range) {
    for (int64_t i = range.begin; i < range.end; i += AT_ONCE) {
        Hinge h;
        VN offset[3][3], slope[4][3], change[9][4][3];
        const VN per_unit = hinge_of(e, e.pos, i, offset, h), pull = -h.length * per_unit, weight = load<VN>(e.hinge_weight + i);
        hinge_slopes(h, pull, slope);
        VN force = weight * bend_of(h.angle, load<VN>(e.rest_angle + i));
        if (e.hinge_rate) force += load<VN>(e.hinge_rate + i) * weight * bend_of(h.angle, load<VN>(e.hinge_before + i));
        for (int d = 0; d < 9; ++d) {
            VN way[3][3] = {};
            way[d / 3][d % 3] = every(1.0);
            hinge_slopes_along(h, pull, per_unit, slope, way, change[d]);
        }
        int place = 0;
        for (int c = 0; c < 4; ++c)
            for (int d = c; d < 4; ++d)
                for (int k = 0; k < 3; ++k)
                    for (int j = 0; j < 3; ++j, ++place) {
                        // The first corner moves against all others.
                        const VN one = d == 0 ? -(change[j][c][k] + change[3 + j][c][k] + change[6 + j][c][k]) : change[3 * (d - 1) + j][c][k];
                        const VN value = force * one;
                        for (int lane = 0; lane < AT_ONCE; ++lane) blocks[90 * (i + lane) + place] = (T)value[lane];
                    }
    }
}

// The matrix of the model becomes the Hessian, in the memory of those blocks; with the published code's bending it stays Gauss-Newton.
template <class T> void make_exact(Engine& e, T* blocks) {
    constexpr int PAIRS[4][4] = {{0, 1, 2, 3}, {1, 4, 5, 6}, {2, 5, 7, 8}, {3, 6, 8, 9}};
    e.indefinite_share = 1.0;
    gather_matrix<T>(e);
    if (e.bending != 1) return;
    T* matrix = (T*)e.matrix;
    for_parts(e.parts, [&](int64_t part) { hinge_curvatures<T>(e, blocks, hinges_of(e, part)); });
    for_parts(e.parts, [&](int64_t part) {
        const Range range = rows_of(e, part);
        for (int64_t row = range.begin; row < range.end; ++row)
            for (int count = 4; count > 0; --count)
                for (int64_t i = e.hinge_starts[4 * row + 4 - count]; i < e.hinge_starts[4 * row + 5 - count]; ++i) {
                    const int32_t* use = e.hinge_uses + 5 * i;
                    const int c = use[0] & 3;
                    for (int b = 1; b <= count; ++b) {
                        const int d = use[b] & 3;
                        const T* block = blocks + 90 * (int64_t)(use[0] >> 2) + 9 * PAIRS[c][d];
                        T* target = blocks_of(e, matrix, row) + 24 * (int64_t)(use[b] >> 2);
                        for (int k = 0; k < 3; ++k)
                            for (int j = 0; j < 3; ++j) target[8 * k + j] += c <= d ? block[3 * k + j] : block[3 * j + k];
                    }
                }
    });
}

// ---- the line search -----------------------------------------------------------------------------------------------------

// The same as below for points: how their vertices give, each along its own block.
template <class T> void prepare_points(const Engine& e, const Points& set) {
    for (int64_t w = 0; w < set.num_walls; ++w)
        for (int64_t i = 0; i < set.count; ++i) {
            const double *normal = set.walls[w].normal + 3 * i, *weights = set.weights + 3 * i;
            double here[3], step[3] = {0.0, 0.0, 0.0}, *stop = set.path + 14 * (w * set.count + i);
            point_at(set, i, e.pos, here);
            for (int k = 0; k < 14; ++k) stop[k] = 0.0;
            for (int c = 0; c < 3; ++c) {
                const int64_t row = set.corners[3 * i + c];
                if (row >= e.num_rows) continue;
                const T* m = own_block(e, (const T*)e.inverse, row);
                for (int k = 0; k < 3; ++k) {
                    step[k] += weights[c] * e.direction[4 * row + k];
                    stop[3 * c + k] = weights[c] * ((double)m[k] * normal[0] + (double)m[8 + k] * normal[1] + (double)m[16 + k] * normal[2]);
                }
                stop[9] += weights[c] * dot3(stop + 3 * c, normal);
            }
            const double start = depth_of(set.walls[w], i, here);
            for (int k = 0; k < 3; ++k) here[k] += step[k];
            stop[10] = start > 0.0 ? start : 0.0;
            stop[11] = stop[9] > 0.0 && (start > 0.0 || depth_of(set.walls[w], i, here) > 0.0);
        }
}

// What stops vertices at walls on the way of a step: give (3), compliance, depth at the start, 1 where it acts.
template <class T> void prepare_path(const Engine& e) {
    const T* inverse = (const T*)e.inverse;
    for_parts(e.parts, [&](int64_t part) {
        const Range rows = rows_of(e, part);
        for (int64_t w = 0; w < e.num_walls; ++w)
            for (int64_t row = rows.begin; row < rows.end; ++row) {
                const double *pos = e.pos + 4 * row, *step = e.direction + 4 * row, *normal = e.walls[w].normal + 3 * row;
                const double end[3] = {pos[0] + step[0], pos[1] + step[1], pos[2] + step[2]};
                const double here = depth_of(e.walls[w], row, pos), there = depth_of(e.walls[w], row, end);
                double* stop = e.path + 8 * (w * e.num_rows + row);
                stop[5] = here > 0.0 || there > 0.0;
                if (stop[5] == 0.0) continue;
                for (int k = 0; k < 3; ++k) {
                    const T* m = own_block(e, inverse, row) + k;
                    stop[k] = (double)m[0] * normal[0] + (double)m[8] * normal[1] + (double)m[16] * normal[2];
                }
                stop[3] = dot3(stop, normal);
                stop[4] = here > 0.0 ? here : 0.0;
            }
    });
    for (int64_t s = 0; s < e.num_points; ++s) prepare_points<T>(e, e.points[s]);
}

// Points ask their vertices to give way; a vertex takes the mean of what those that push ask, see hood.solver.system.line_search.
void walk_points(const Engine& e, const Points& set) {
    for (int64_t w = 0; w < set.num_walls; ++w) {
        const Wall& wall = set.walls[w];
        double* path = set.path + 14 * w * set.count;
        place(e, e.trial_acc, e.trial_pos);
        for (int64_t i = 0; i < set.count; ++i) {
            double *stop = path + 14 * i, x[3];
            stop[12] = 0.0;
            if (stop[11] == 0.0) continue;
            point_at(set, i, e.trial_pos, x);
            stop[12] = contact_push(weight_of(wall, i), stop[10], depth_of(wall, i, x), stop[9]);
        }
        for (int64_t row = 0; row < e.num_rows; ++row) {
            double moved[3] = {0.0, 0.0, 0.0}, count = 0.0;
            for (int32_t i = set.starts[row]; i < set.starts[row + 1]; ++i) {
                const int32_t* use = set.uses + 5 * (int64_t)i;
                const double* stop = path + 14 * (int64_t)use[0];
                if (!(stop[12] > 0.0)) continue;
                for (int k = 0; k < 3; ++k) moved[k] += stop[12] * stop[3 * use[1] + k];
                count += 1.0;
            }
            if (count > 0.0)
                for (int k = 0; k < 3; ++k) e.trial_acc[4 * row + k] += moved[k] / count / e.dt_sq;
        }
    }
}

void walk(const Engine& e, double length) {
    const double step = length / e.dt_sq;
    for_parts(e.parts, [&](int64_t part) {
        const Range rows = rows_of(e, part);
        for (int64_t row = rows.begin; row < rows.end; ++row)
            for (int k = 0; k < 3; ++k) e.trial_acc[4 * row + k] = e.acc[4 * row + k] + step * e.direction[4 * row + k];
        for (int64_t w = 0; w < e.num_walls; ++w) {
            const Wall& wall = e.walls[w];
            for (int64_t row = rows.begin; row < rows.end; ++row) {
                const double* stop = e.path + 8 * (w * e.num_rows + row);
                if (stop[5] == 0.0) continue;
                double *acc = e.trial_acc + 4 * row, pos[3];
                for (int k = 0; k < 3; ++k) pos[k] = e.base[3 * row + k] + e.dt_sq * acc[k];
                const double push = contact_push(wall.weight, stop[4], depth_of(wall, row, pos), stop[3]) / e.dt_sq;
                if (!(push > 0.0)) continue;
                for (int k = 0; k < 3; ++k) acc[k] += push * stop[k];
            }
        }
        if (!e.num_points) place(e, e.trial_acc, e.trial_pos, rows);
    });
    if (!e.num_points) return;
    for (int64_t s = 0; s < e.num_points; ++s) walk_points(e, e.points[s]);
    place(e, e.trial_acc, e.trial_pos);
}

// Shortens the way from the state to the trial to a share of it.
void shorten_trial(const Engine& e, double share) {
    for (int64_t row = 0; row < e.num_rows; ++row)
        for (int k = 0; k < 3; ++k) e.trial_acc[4 * row + k] = e.acc[4 * row + k] + share * (e.trial_acc[4 * row + k] - e.acc[4 * row + k]);
    place(e, e.trial_acc, e.trial_pos);
}

// The share of the way from the state to the trial on which no cloth meets cloth.
double free_share(const Engine& e) {
    if (!e.layers) return 1.0;
    LayerView& layers = *e.layers;
    const double *here = own_order(e, e.pos, layers.here), *there = own_order(e, e.trial_pos, layers.there);
    return layers.limit(layers.layers, here, there, e.kept);
}

// Bends the way to the trial, of which little is free, around cloth.
void ease_trial(const Engine& e) {
    e.layers->ease(e.layers->layers, e.layers->here, e.layers->there, e.kept);
    for (int64_t row = 0; row < e.num_rows; ++row) {
        const double* base = e.base + 3 * row;
        for (int k = 0; k < 3; ++k) e.trial_acc[4 * row + k] = (e.layers->there[3 * e.vertex_of_scene[row] + k] - base[k]) / e.dt_sq;
    }
    place(e, e.trial_acc, e.trial_pos);
}

void take_trial(Engine& e, bool modelled, double phi, double noise) {
    std::memcpy(e.pos, e.trial_pos, sizeof(double) * 4 * e.num_rows);
    std::memcpy(e.acc, e.trial_acc, sizeof(double) * 4 * e.num_rows);
    e.modelled = modelled, e.phi = phi, e.noise = noise;
}

bool backtrack(Engine& e) {
    double slope = 0.0, length = 1.0;
    for (int64_t row = 0; row < e.num_rows; ++row) slope += dot3(e.gradient + 4 * row, e.direction + 4 * row);
    if (!(slope < 0.0)) return false;
    e.modelled = false;
    for (int attempt = 0; attempt < 40; ++attempt) {
        double phi, noise;
        const bool model = attempt == 0;  // most often the first one is taken
        walk(e, length);
        const double share = free_share(e);
        if (share < e.eased) {
            ease_trial(e);
            energy(e, e.trial_pos, e.trial_acc, false, &phi, &noise);
            if (phi <= e.phi + 1e-4 * length * slope + e.noise) {
                take_trial(e, false, phi, noise);
                return true;
            }
            walk(e, length);
        }
        if (share < 1.0) shorten_trial(e, share);
        length *= share;
        energy(e, e.trial_pos, e.trial_acc, model, &phi, &noise);
        if (phi <= e.phi + 1e-4 * length * slope + e.noise) {
            take_trial(e, model, phi, noise);
            return true;
        }
        // The minimum of the parabola through what is known, between a tenth and a half of the last length.
        const double excess = phi - e.phi - length * slope;
        double shorter = std::isfinite(excess) && excess > 0.0 ? -0.5 * slope * length * length / excess : 0.1 * length;
        if (!(shorter > 0.1 * length)) shorter = 0.1 * length;
        length = shorter < 0.5 * length ? shorter : 0.5 * length;
    }
    return false;
}

// x with A x = b for a symmetric positive A by its upper triangle, by cofactors, scaled to a diagonal of ones first.
inline void solve_block(const double* upper, const double* b, double* x) {
    constexpr int DIAGONAL[3] = {0, 3, 5};
    double scale[3], a[3][3], c[3][3];
    for (int i = 0; i < 3; ++i) {
        const double own = upper[DIAGONAL[i]];
        scale[i] = 1.0 / std::sqrt(own > 0.0 ? own : 2.2250738585072014e-308);
    }
    for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j) a[i][j] = upper[PAIR[i][j]] * scale[i] * scale[j];
    for (int i = 0; i < 3; ++i) {
        const double *u = a[(i + 1) % 3], *v = a[(i + 2) % 3];
        c[i][0] = u[1] * v[2] - u[2] * v[1], c[i][1] = u[2] * v[0] - u[0] * v[2], c[i][2] = u[0] * v[1] - u[1] * v[0];
    }
    double determinant = dot3(a[0], c[0]);
    if (!(determinant > 1.1920928955078125e-07)) determinant = 1.1920928955078125e-07;
    for (int i = 0; i < 3; ++i) {
        x[i] = 0.0;
        for (int j = 0; j < 3; ++j) x[i] += c[i][j] * scale[j] * b[j];
        x[i] *= scale[i] / determinant;
    }
}

// ---- where a step begins -------------------------------------------------------------------------------------------------

void hold_fixed(const Engine& e) {
    for (int64_t i = e.num_rows; i < e.num_vertices; ++i)
        for (int k = 0; k < 3; ++k) e.pos[4 * i + k] = e.trial_pos[4 * i + k] = e.fixed[3 * i + k];
}

// Free flight, falling or not, then out of the first wall, as far as it carries the weight.
void guess(const Engine& e, const double* mass, const double* gravity, bool falls, double* acc) {
    const bool walled = e.num_walls && e.walls[0].weight > 0.0;
    const double size = std::sqrt(dot3(gravity, gravity));
    for (int64_t row = 0; row < e.num_rows; ++row) {
        const int64_t v = e.vertex[row];
        double pos[3];
        for (int k = 0; k < 3; ++k) pos[k] = e.base[3 * row + k] + (falls ? e.dt_sq * gravity[k] : 0.0);
        if (walled) {
            const double out = depth_of(e.walls[0], row, pos) - contact_depth(e.walls[0].weight, mass[v] * size);
            if (out > 0.0)
                for (int k = 0; k < 3; ++k) pos[k] += out * e.walls[0].normal[3 * row + k];
        }
        for (int k = 0; k < 3; ++k) acc[4 * row + k] = (pos[k] - e.base[3 * row + k]) / e.dt_sq;
    }
}

}  // namespace

// ---- what is called ------------------------------------------------------------------------------------------------------

extern "C" {

// Accelerations (V, 3) in the original order become the state; potential and rounding with them.
void newton_start(Engine* e, const double* acc) {
    hold_fixed(*e);
    for (int64_t row = 0; row < e->num_rows; ++row)
        for (int k = 0; k < 3; ++k) e->acc[4 * row + k] = acc[3 * e->vertex[row] + k];
    place(*e, e->acc, e->pos);
    energy(*e, e->pos, e->acc, true, &e->phi, &e->noise);
    e->modelled = true;
}

// The better of two guesses becomes the state, see hood.solver.system.iterate.first_iterate; masses (V) kg, gravity (3) m/s^2.
void newton_guess(Engine* e, const double* mass, const double* gravity) {
    LayerView* const layers = e->layers;  // the guess is the one that would be best without
    const LayerGrips* const layer_grips = e->layer_grips;
    e->layers = nullptr, e->layer_grips = nullptr;
    hold_fixed(*e);
    double phi, noise;
    guess(*e, mass, gravity, true, e->trial_acc);
    place(*e, e->trial_acc, e->trial_pos);
    energy(*e, e->trial_pos, e->trial_acc, false, &phi, &noise);
    guess(*e, mass, gravity, false, e->acc);
    place(*e, e->acc, e->pos);
    energy(*e, e->pos, e->acc, true, &e->phi, &e->noise);  // cloth seldom falls freely
    e->modelled = true;
    if (!(e->phi < phi)) take_trial(*e, false, phi, noise);
    e->layers = layers, e->layer_grips = layer_grips;
}

// Gradient at the state, and what the matrix is made of; returns the norm of the gradient.
double newton_model(Engine* e) {
    differentiate<Real>(*e);
    double sum = 0.0;
    for (int64_t row = 0; row < e->num_rows; ++row) sum += dot3(e->gradient + 4 * row, e->gradient + 4 * row);
    return std::sqrt(sum);
}

// The matrix with a share of the indefinite part, from the model.
void newton_matrix(Engine* e, double indefinite_share) {
    e->indefinite_share = indefinite_share;
    gather_matrix<Real>(*e);
}

// The Hessian from the model, in ``memory`` for (H, 90) numbers of the matrix.
void newton_exact(Engine* e, void* memory) { make_exact<Real>(*e, (Real*)memory); }

// x (V, 3) with matrix x = ``right`` (V, 3) in the original order, of free vertices, to a tolerance; 1 where the matrix was positive
// definite as far as was seen. Rows of other vertices are not touched; the gradient is no longer known.
int64_t newton_solve(Engine* e, const double* right, double tolerance, int64_t most, double* x) {
    for (int64_t row = 0; row < e->num_rows; ++row)
        for (int k = 0; k < 3; ++k) e->gradient[4 * row + k] = -right[3 * e->vertex[row] + k];
    const bool definite = solve<Real>(*e, tolerance, most);
    for (int64_t row = 0; row < e->num_rows; ++row)
        for (int k = 0; k < 3; ++k) x[3 * e->vertex[row] + k] = e->direction[4 * row + k];
    return definite;
}

// From the model to the next state, by a linear system that is solved to a tolerance; 1 where it moved.
int64_t newton_move(Engine* e, double tolerance, int64_t cg_iterations) {
    direct<Real>(*e, tolerance, cg_iterations);
    prepare_path<Real>(*e);
    return backtrack(*e);
}

// The state in the original order: positions (V, 3), accelerations (V, 3) of free vertices.
void newton_state(const Engine* e, double* pos, double* acc) {
    for (int64_t i = 0; i < e->num_vertices; ++i)
        for (int k = 0; k < 3; ++k) {
            const int64_t v = e->vertex[i];
            pos[3 * v + k] = e->pos[4 * i + k];
            if (i < e->num_rows) acc[3 * v + k] = e->acc[4 * i + k];
        }
}

int64_t newton_face_record() { return sizeof(FaceRecord<Real>); }
int64_t newton_hinge_record() { return sizeof(HingeRecord<Real>); }

// ---- single vertices on their own -----------------------------------------------------------------------------------------

// Forces (V, 3) on free vertices at positions (V, 3) in the original order, and the steps (V, 3) each would take with its
// neighbours held: by its diagonal block of the positive matrix. Rows of other vertices are not touched, nor is the matrix.
void newton_alone(Engine* e, const float* pos, float* force, float* step) {
    constexpr int DIAGONAL[3] = {0, 3, 5};
    for (int64_t i = 0; i < e->num_vertices; ++i) {
        const int64_t v = e->vertex[i];
        for (int k = 0; k < 3; ++k) {
            e->pos[4 * i + k] = pos[3 * v + k];
            if (i < e->num_rows) e->acc[4 * i + k] = (e->pos[4 * i + k] - e->base[3 * i + k]) / e->dt_sq;
        }
    }
    e->modelled = false;
    differentiate<Real>(*e);
    for (int64_t row = 0; row < e->num_rows; ++row) {
        const Real* blocks = (const Real*)e->own + 6 * row;
        double upper[6];
        for (int k = 0; k < 6; ++k) upper[k] = blocks[k];
        if (e->membrane)
            for (int64_t i = e->face_starts[3 * row]; i < e->face_starts[3 * (row + 1)]; ++i) {
                const int32_t use = e->face_uses[4 * i];
                const FaceRecord<Real>& face = ((const FaceRecord<Real>*)e->face_model)[use >> 2];
                const int c = use & 3;
                for (int m = 0; m < 3; ++m) {
                    const Real* root = face.root + 9 * m + 3 * c;
                    const double own[3] = {root[0], root[1], root[2]};
                    add_outer(upper, 1.0, own);
                }
                for (int k = 0; k < 3; ++k) upper[DIAGONAL[k]] += face.axial[2 * DIAGONAL[c]];
            }
        if (e->bending)
            for (int64_t i = e->hinge_starts[4 * row]; i < e->hinge_starts[4 * (row + 1)]; ++i) {
                const int32_t use = e->hinge_uses[5 * i];
                const Real* of = ((const HingeRecord<Real>*)e->hinge_model)[use >> 2].row + 3 * (use & 3);
                const double own[3] = {of[0], of[1], of[2]};
                add_outer(upper, 1.0, own);
            }
        for (int64_t i = e->spring_starts[2 * row]; i < e->spring_starts[2 * (row + 1)]; ++i)
            for (int k = 0; k < 3; ++k) upper[DIAGONAL[k]] += e->spring_stiffness[e->spring_uses[3 * i] >> 2];
        const int64_t v = e->vertex[row];
        const double pull[3] = {-e->gradient[4 * row], -e->gradient[4 * row + 1], -e->gradient[4 * row + 2]};
        double moved[3];
        solve_block(upper, pull, moved);
        for (int k = 0; k < 3; ++k) force[3 * v + k] = (float)pull[k], step[3 * v + k] = (float)moved[k];
    }
}

// The steps (V, 3) that free vertices would take together under other forces (V, 3), with the positive matrix at the positions that
// were looked at last and so much more on its diagonal (V): as many iterations of conjugate gradients, however near they come.
void newton_together(Engine* e, const float* force, const float* damping, int64_t iterations, float* step) {
    typedef typename Four<Real>::type V4;
    e->indefinite_share = 0.0;
    gather_matrix<Real>(*e);
    for (int64_t row = 0; row < e->num_rows; ++row) {
        const int64_t v = e->vertex[row];
        Real* block = blocks_of(*e, (Real*)e->matrix, row);
        for (int k = 0; k < 3; ++k) {
            e->gradient[4 * row + k] = -(double)force[3 * v + k];
            block[9 * k] += (Real)damping[v];
        }
        for (int k = 0; k < 3; ++k) store(own_block(*e, (Real*)e->block, row) + 8 * k, load<V4>(block + 8 * k));
    }
    invert_blocks<Real>(*e, {0, e->num_rows});
    solve_by_blocks<Real>(*e, iterations);
    for (int64_t row = 0; row < e->num_rows; ++row)
        for (int k = 0; k < 3; ++k) step[3 * e->vertex[row] + k] = (float)e->direction[4 * row + k];
}

}
