// Closest points on a triangle surface by a tree of boxes: built once for a topology, refitted to the positions of every call.
//
// The search is exact, and its result does not depend on the tree, on the searches before it, or on the order of faces visited: of
// faces at the same distance the one with the lowest number is taken. Distances are float64. The faces of one leaf bound the distance
// of a point; then all boxes within that bound are listed, level by level: lists that grow without a branch are several times as
// fast as a branch at every box. Boxes are float32, about the middle of the surface, and their distances are taken as that much less.
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "eights.h"
#include "halving.h"
#include "lanes.h"
#include "threads.h"
#include "vector.h"

namespace {

constexpr int WIDE = LANES;  // children of a group, faces of a leaf
constexpr int BLOCK = AT_ONCE < 4 ? 4 : AT_ONCE;  // vertices of a block: a leaf has four, more or less
constexpr int MOST = 64;  // points of a batch
constexpr int MOST_PAIRS = 256;  // faces and points that are tried together
constexpr double TINY = 2.2250738585072014e-308;
constexpr double NONE = 1e300;  // the number of no face and of no vertex

typedef float F8 __attribute__((vector_size(32)));
typedef float F4 __attribute__((vector_size(16)));
typedef float FN __attribute__((vector_size(4 * AT_ONCE)));

// The second where one is not a number.
template <class V> inline V least(V a, V b) { return a < b ? a : b; }
template <class V> inline V greatest(V a, V b) { return a > b ? a : b; }

inline double least_lane(VN v) {
    alignas(sizeof(VN)) double lane[AT_ONCE];
    store(lane, v);
    double low[AT_ONCE];
    for (int i = 0; i < AT_ONCE / 2; ++i) low[i] = lane[i + AT_ONCE / 2] < lane[i] ? lane[i + AT_ONCE / 2] : lane[i];
    for (int half = AT_ONCE / 4; half; half /= 2)
        for (int i = 0; i < half; ++i) low[i] = low[i + half] < low[i] ? low[i + half] : low[i];
    return low[0];
}

inline void put(double* p, Vec a) { p[0] = a.x, p[1] = a.y, p[2] = a.z; }
inline double clamp(double v) { return v < 0.0 ? 0.0 : v > 1.0 ? 1.0 : v; }

struct Axes {
    VN x, y, z;
};
inline Axes operator-(Axes a, Axes b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline VN dot(Axes a, Axes b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Axes along(Axes a, VN s, Axes b) { return {a.x - s * b.x, a.y - s * b.y, a.z - s * b.z}; }
inline Axes load_axes(const double* p) { return {load<VN>(p), load<VN>(p + WIDE), load<VN>(p + 2 * WIDE)}; }

}  // namespace

extern "C" {

struct Tree {
    int64_t num_faces, num_vertices, num_leaves, num_blocks, edge_width;
    // The topology. Places are those of faces in the order: leaf times eight and lane.
    const int64_t* faces;                     // (G, 3)
    const int64_t *around, *first, *valence;  // (3G), (W), (W), see hood.mesh.closest_point.search.Incidence
    const int64_t *face_edges, *edge_faces;   // (G, 3), (E, M) with -1
    int32_t* order;         // (L, 8) the faces in the tree, leaf after leaf; the last one is repeated
    int32_t* place;         // (G) where they are in it, -1 for others
    double* number;         // (L, 8) the order again
    int32_t* corner_of;     // (L, 3, 8) corners of the faces of a leaf
    int32_t* block_first;   // (L + 1) blocks of a leaf: vertices of its faces, each in one leaf; the last one of a leaf is repeated
    int32_t* block_vertex;  // (B, BLOCK)
    double* block_number;   // (B, BLOCK) the same
    int32_t *fan_first, *fan;  // (W + 1), (9G) corners of the faces around a vertex: two that follow each other belong to a face
    double* fan_share;         // (9G) what a corner counts in the average over the corners of these faces
    // The positions of this call.
    double* pos;                      // (W, 3) m
    double* corners;                  // (L, 9, 8) m, corners of the faces of a leaf
    float* face_boxes;                // (L, 6, 8) m, least and greatest corners of the faces of a leaf, about the origin
    float* boxes;                     // (M, 6, 8) m, those of eight leaves, then of eight of these, level after level
    double* block_pos;                // (B, 3, BLOCK) m
    double* vertex_normal;            // (W, 6) unit normals, now and next, of the vertices that this call needed
    double* bulge;                    // (2, W) 1/m, their curvatures before an average and after it
    int32_t* needed;                  // (W + 1) these vertices
    int32_t* stamp;                   // (W) the call in which they were last needed
    int64_t call;
    double origin[3], size_sq;        // m, m^2: middle of everything, and how far that reaches
    int64_t batch;                    // points that are searched for together, at most 64
    int64_t parts;                    // in which the points of a call are searched for, by threads
    float* leaf_normals;              // (L, 3, 8) unit normals of the faces of a leaf
    float* normal_boxes;              // (M, 6, 8) least and greatest of these, as the boxes
    int64_t normals_of;               // the fit, see fits, that these are of
    int64_t fits;                     // how often positions were taken up
    uint64_t *visits, *next_visits, *near;  // (parts, batch * L + 8) each, what points of a batch are to visit, see Visit
};

// The nearest surface points of the points of a query, and what another side of a fold is.
struct Matched {
    const uint8_t* valid;                 // (N)
    const double *dist, *point, *normal;  // (N), (N, 3), (N, 3)
    double ahead, near, cosine, behind;
};

struct Query {
    int64_t count;
    const double* points;    // (N, 3)
    const double* next_pos;  // (W, 3) m, where the surface goes
    int64_t *vertex, *face;  // (N)
    double *vertex_dist, *bary, *dist;                  // (N), (N, 3), (N)
    double *point, *normal, *next_point, *next_normal;  // (N, 3) each
    double* curvature;       // (N) 1/m, none where nobody asks
    double most_curvature;   // 1/m
    int64_t rounds;          // of averaging
    const int64_t* hint;     // (N) faces that are near, as those found a step before: they save visits; none where none is known
};
}

namespace {

// Weights of the point of a triangle that is closest to p; those of corners that it does not touch are exactly 0.
void closest_on_triangle(Vec p, Vec a, Vec b, Vec c, double* bary, Vec* offset) {
    const Vec u = b - a, v = c - a, q = p - a;
    const double uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), pu = dot(q, u), pv = dot(q, v);
    const double det = uu * vv - uv * uv;
    if (det > EPS * uu * vv) {
        const double s = (vv * pu - uv * pv) / det, t = (uu * pv - uv * pu) / det;
        if (s >= 0.0 && t >= 0.0 && s + t <= 1.0) {
            const double rest = 1.0 - s - t;
            bary[0] = rest < 0.0 ? 0.0 : rest, bary[1] = s, bary[2] = t;
            *offset = q - s * u - t * v;
            return;
        }
    }
    const Vec w = c - b, r = p - b;
    const double on_u = clamp(pu / std::max(uu, TINY)), on_v = clamp(pv / std::max(vv, TINY));
    const double on_w = clamp(dot(r, w) / std::max(dot(w, w), TINY));
    const Vec by_u = q - on_u * u, by_v = q - on_v * v, by_w = r - on_w * w;
    const double miss_u = dot(by_u, by_u), miss_v = dot(by_v, by_v), miss_w = dot(by_w, by_w);
    if (miss_w < miss_u && miss_w < miss_v) {
        bary[0] = 0.0, bary[1] = 1.0 - on_w, bary[2] = on_w;
        *offset = by_w;
    } else if (miss_v < miss_u) {
        bary[0] = 1.0 - on_v, bary[1] = 0.0, bary[2] = on_v;
        *offset = by_v;
    } else {
        bary[0] = 1.0 - on_u, bary[1] = on_u, bary[2] = 0.0;
        *offset = by_u;
    }
}

inline VN share(VN value, VN size) {
    return least(greatest(value / greatest(size, every(TINY)), every(0.0)), every(1.0));
}

// Squared distances from q, relative to the first corner, to triangles: what closest_on_triangle finds.
inline VN triangle_dist_sq(Axes q, Axes u, Axes v) {
    const VN zero = every(0.0), one = every(1.0), uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), pu = dot(q, u), pv = dot(q, v);
    const VN det = uu * vv - uv * uv;
    const IN regular = det > EPS * uu * vv;
    const VN safe = regular ? det : one, s = (vv * pu - uv * pv) / safe, t = (uu * pv - uv * pu) / safe;
    const IN inside = regular & (s >= zero) & (t >= zero) & (s + t <= one);
    const Axes w = v - u, r = q - u, free = along(along(q, s, u), t, v);
    const Axes by_u = along(q, share(pu, uu), u), by_v = along(q, share(pv, vv), v), by_w = along(r, share(dot(r, w), dot(w, w)), w);
    return inside ? dot(free, free) : least(dot(by_u, by_u), least(dot(by_v, by_v), dot(by_w, by_w)));
}

// The least distance in each lane, and whose it is.
struct Least {
    VN dist_sq = every(INFINITY), number = every(NONE);

    void take(VN other_dist_sq, VN other_number) {
        const IN better = (other_dist_sq < dist_sq) | ((other_dist_sq == dist_sq) & (other_number < number));
        dist_sq = better ? other_dist_sq : dist_sq;
        number = better ? other_number : number;
    }
};

struct Found {
    double dist_sq, number;
};

inline Found first_of(const Least& least) {
    alignas(sizeof(VN)) double dist_sq[AT_ONCE], number[AT_ONCE];
    store(dist_sq, least.dist_sq), store(number, least.number);
    for (int half = AT_ONCE / 2; half; half /= 2)
        for (int i = 0; i < half; ++i) {
            const double d = dist_sq[i + half], n = number[i + half];
            const bool better = (d < dist_sq[i]) | ((d == dist_sq[i]) & (n < number[i]));
            dist_sq[i] = better ? d : dist_sq[i], number[i] = better ? n : number[i];
        }
    return {dist_sq[0], number[0]};
}

inline Axes everywhere(Vec p) { return {every(p.x), every(p.y), every(p.z)}; }

// Squared distances to boxes; not a number where there is no box.
template <class V, class T> inline V box_dist_sq(const T* box, T x, T y, T z) {
    const V zero{};
    const V dx = greatest(zero, greatest(load<V>(box) - x, x - load<V>(box + 3 * WIDE)));
    const V dy = greatest(zero, greatest(load<V>(box + WIDE) - y, y - load<V>(box + 4 * WIDE)));
    const V dz = greatest(zero, greatest(load<V>(box + 2 * WIDE) - z, z - load<V>(box + 5 * WIDE)));
    return dx * dx + dy * dy + dz * dz;
}

// Squared distances of boxes beyond this cannot belong to anything within the distance, whatever rounding does: with an error
// of e, (d + e)^2 <= d^2 (1 + 1e-3) + e^2 (1 + 1e3). Coordinates of size s have e < 4e-7 s in float32.
inline float limit_of(double dist_sq, double size_sq) { return (float)(dist_sq * (1.0 + 1e-3) + 1.6e-10 * size_sq + 1e-37); }

// A point of a batch on its way.
struct Walk {
    Vec p;
    float x, y, z;  // about the tree's origin
    float limit, face_limit;
    Found face;
    Least vertices;
    int64_t leaf;  // whose faces were tried first
};

inline void place_walk(const Tree& tree, Walk& walk, Vec p) {
    walk.p = p;
    // Of places farther than this the limits are infinite: every box is within them, as long as distances are numbers.
    const auto local = [&](double x, int k) { return (float)std::min(std::max(x - tree.origin[k], -1e38), 1e38); };
    walk.x = local(p.x, 0), walk.y = local(p.y, 1), walk.z = local(p.z, 2);
}

inline F8 boxes_dist_sq(const float* boxes, const Walk& walk) { return box_dist_sq<F8>(boxes, walk.x, walk.y, walk.z); }

// The leaf whose boxes look nearest on the way down; positive floats are ordered as integers are, and the last three bits hold the
// lane.
int64_t likely_leaf(const Tree& tree, const Levels& levels, const Walk& walk) {
    int64_t group = 0;
    for (int level = levels.count - 1; level >= 0; --level) {
        alignas(32) int32_t key[WIDE];
        store(key, boxes_dist_sq(tree.boxes + 6 * WIDE * (levels.first[level] + group), walk));
        for (int i = 0; i < WIDE; ++i) key[i] = (key[i] & ~(INT32_MIN | 7)) | i;
        for (int half = WIDE / 2; half; half /= 2)
            for (int i = 0; i < half; ++i) key[i] = std::min(key[i], key[i + half]);
        group = WIDE * group + (key[0] & 7);
    }
    return group;
}

// Begins at a leaf: its faces bound the distance, and their corners that of the nearest vertex.
void begin_at(const Tree& tree, Walk& walk, int64_t leaf) {
    const Axes p = everywhere(walk.p);
    Least faces;
    VN corner_sq = every(INFINITY);
    for (int i = 0; i < WIDE; i += AT_ONCE) {
        const double* table = tree.corners + 9 * WIDE * leaf + i;
        const Axes a = load_axes(table), b = load_axes(table + 3 * WIDE), c = load_axes(table + 6 * WIDE);
        faces.take(triangle_dist_sq(p - a, b - a, c - a), load<VN>(tree.number + WIDE * leaf + i));
        for (const Axes& corner : {p - a, p - b, p - c}) corner_sq = least(dot(corner, corner), corner_sq);
    }
    const Vec local = walk.p - at(tree.origin, 0);
    const double size_sq = tree.size_sq + dot(local, local);
    walk.leaf = leaf, walk.face = first_of(faces), walk.vertices = Least{};
    walk.face_limit = limit_of(walk.face.dist_sq, size_sq);
    walk.limit = std::max(limit_of(least_lane(corner_sq), size_sq), walk.face_limit);
}

// What a point of a batch is to visit: a group, a leaf or the place of a face, and the point's number in the last bits.
typedef uint64_t Visit;
constexpr Visit ITEM = MOST;

inline Visit first_below(Visit visit) { return visit / ITEM * ITEM * (WIDE - 1) + visit; }

// Lists what is below a visit in the lanes that hold, without a branch.
template <class Mask> inline void list_lanes(Mask mask, Visit first, Visit* list, int64_t& count) {
    alignas(sizeof(Mask)) int32_t lane[WIDE];
    store(lane, mask);
    for (int i = 0; i < WIDE; ++i) {
        list[count] = first + i * ITEM;
        count -= lane[i];
    }
}

// There is room for a whole register of pairs.
void try_pairs(const Tree& tree, Walk* walks, Visit* pairs, int64_t count) {
    if (!count) return;
    for (int64_t i = count; i % AT_ONCE; ++i) pairs[i] = pairs[count - 1];
    for (int64_t i = 0; i < count; i += AT_ONCE) {
        const double *point[AT_ONCE], *corner[3][AT_ONCE];
        for (int lane = 0; lane < AT_ONCE; ++lane) {
            const uint64_t place = pairs[i + lane] / ITEM;
            point[lane] = &walks[pairs[i + lane] % ITEM].p.x;
            for (int c = 0; c < 3; ++c) corner[c][lane] = tree.pos + 3 * (int64_t)tree.corner_of[WIDE * (3 * (place / WIDE) + c) + place % WIDE];
        }
        const auto axes = [](const double* const* row) {
            return Axes{gather([&](int lane) { return row[lane][0]; }), gather([&](int lane) { return row[lane][1]; }),
                        gather([&](int lane) { return row[lane][2]; })};
        };
        const Axes p = axes(point), a = axes(corner[0]), b = axes(corner[1]), c = axes(corner[2]);
        alignas(sizeof(VN)) double dist_sq[AT_ONCE];
        store(dist_sq, triangle_dist_sq(p - a, b - a, c - a));
        for (int lane = 0; lane < AT_ONCE; ++lane) {
            Found& best = walks[pairs[i + lane] % ITEM].face;
            const double number = tree.order[pairs[i + lane] / ITEM];
            const bool better = (dist_sq[lane] < best.dist_sq) | ((dist_sq[lane] == best.dist_sq) & (number < best.number));
            best.dist_sq = better ? dist_sq[lane] : best.dist_sq, best.number = better ? number : best.number;
        }
    }
}

// Vertices of the leaves of the k-th visit and of those behind it for the same point; returns where those of another one begin.
int64_t try_vertices(const Tree& tree, Walk* walks, const Visit* visits, int64_t k, int64_t end) {
    const Visit number = visits[k] % ITEM;
    const Axes p = everywhere(walks[number].p);
    Least best;
    for (; k < end && visits[k] % ITEM == number; ++k) {
        const int32_t* block = tree.block_first + visits[k] / ITEM;
        for (int64_t i = BLOCK * (int64_t)block[0]; i < BLOCK * (int64_t)block[1]; i += AT_ONCE) {
            const double* pos = tree.block_pos + 3 * (i / BLOCK * BLOCK) + i % BLOCK;
            const Axes gap = p - Axes{load<VN>(pos), load<VN>(pos + BLOCK), load<VN>(pos + 2 * BLOCK)};
            best.take(dot(gap, gap), load<VN>(tree.block_number + i));
        }
    }
    walks[number].vertices = best;
    return k;
}

// Faces and vertices that may be the nearest of the points of a batch.
void walk_together(const Tree& tree, const Levels& levels, Walk* walks, int32_t count) {
    Visit *from = tree.visits, *to = tree.next_visits;
    int64_t left = count, near = 0;
    for (int32_t q = 0; q < count; ++q) from[q] = (Visit)q;
    for (int level = levels.count - 1; level >= 0; --level) {
        const float* boxes = tree.boxes + 6 * WIDE * levels.first[level];
        int64_t listed = 0;
        for (int64_t k = 0; k < left; ++k) {
            const Walk& walk = walks[from[k] % ITEM];
            const F8 away = boxes_dist_sq(boxes + from[k] / ITEM * (6 * WIDE), walk);
            const Visit first = first_below(from[k]);
            list_lanes(away <= walk.limit, first, to, listed);
            if (!level) list_lanes(away <= walk.face_limit, first, tree.near, near);
        }
        std::swap(from, to);
        left = listed;
    }
    for (int64_t k = 0; k < left;) k = try_vertices(tree, walks, from, k, left);
    Visit pairs[MOST_PAIRS];
    int64_t found = 0;
    for (int64_t k = 0; k < near; ++k) {
        const Visit visit = tree.near[k];
        const Walk& walk = walks[visit % ITEM];
        if ((int64_t)(visit / ITEM) == walk.leaf) continue;
        list_lanes(boxes_dist_sq(tree.face_boxes + visit / ITEM * (6 * WIDE), walk) <= walk.face_limit, first_below(visit), pairs, found);
        if (found > MOST_PAIRS - WIDE - AT_ONCE) try_pairs(tree, walks, pairs, found), found = 0;
    }
    try_pairs(tree, walks, pairs, found);
}

// Corners of the faces of a leaf among positions (W, 3).
inline void fill_corners(const Tree& tree, int64_t leaf, const double* pos, double* table) {
    for (int c = 0; c < 3; ++c)
        for (int i = 0; i < WIDE; ++i)
            for (int k = 0; k < 3; ++k) table[WIDE * (3 * c + k) + i] = pos[3 * (int64_t)tree.corner_of[WIDE * (3 * leaf + c) + i] + k];
}

inline Vec unit(Vec a) {
    const double length = std::sqrt(dot(a, a));
    return (1.0 / std::max(length, TINY)) * a;
}

inline Vec face_cross(const Tree& tree, int64_t face) {
    const int64_t* c = tree.faces + 3 * face;
    const Vec here = at(tree.pos, c[0]);
    return cross(at(tree.pos, c[1]) - here, at(tree.pos, c[2]) - here);
}

// Angle-weighted pseudonormal, not normalised, at a point of a face.
Vec pseudonormal(const Tree& tree, int64_t face, const double* bary) {
    const int zeros = (bary[0] == 0.0) + (bary[1] == 0.0) + (bary[2] == 0.0);
    Vec sum{0.0, 0.0, 0.0};
    if (zeros == 0) return face_cross(tree, face);
    if (zeros == 1) {
        const int corner = bary[0] == 0.0 ? 0 : bary[1] == 0.0 ? 1 : 2;
        const int64_t* faces = tree.edge_faces + tree.edge_width * tree.face_edges[3 * face + corner];
        for (int64_t i = 0; i < tree.edge_width; ++i)
            if (faces[i] >= 0) sum = sum + unit(face_cross(tree, faces[i]));
        return sum;
    }
    const int64_t* corners = tree.faces + 3 * face;
    const int64_t vertex = corners[bary[0] != 0.0 ? 0 : bary[1] != 0.0 ? 1 : 2];
    for (int64_t i = 0; i < tree.valence[vertex]; ++i) {
        const int64_t* c = tree.faces + 3 * tree.around[tree.first[vertex] + i];
        const int own = c[0] == vertex ? 0 : c[1] == vertex ? 1 : 2;
        const Vec here = at(tree.pos, vertex), u = at(tree.pos, c[(own + 1) % 3]) - here, v = at(tree.pos, c[(own + 2) % 3]) - here;
        const Vec normal = cross(u, v);
        const double area = std::sqrt(dot(normal, normal));
        if (area > 0.0) sum = sum + (std::atan2(area, dot(u, v)) / area) * normal;
    }
    return sum;
}

// Vertices, one a lane, and the faces around them.
struct Fans {
    int32_t vertex[AT_ONCE], first[AT_ONCE], size[AT_ONCE], turns = 0;

    // The needed vertices from the i-th on; the last one is repeated.
    Fans(const Tree& tree, int64_t i, int64_t count) {
        for (int lane = 0; lane < AT_ONCE; ++lane) {
            const int32_t v = vertex[lane] = tree.needed[std::min(i + lane, count - 1)];
            first[lane] = tree.fan_first[v], size[lane] = tree.fan_first[v + 1] - first[lane];
            turns = std::max(turns, size[lane]);
        }
    }

    // The corners whose turn it is, and what they count; vertices themselves, and nothing, where there are no more.
    void turn(const Tree& tree, int32_t k, int32_t* corner) const {
        for (int lane = 0; lane < AT_ONCE; ++lane) corner[lane] = k < size[lane] ? tree.fan[first[lane] + k] : vertex[lane];
    }
    VN share(const Tree& tree, int32_t k) const {
        return gather([&](int lane) { return k < size[lane] ? tree.fan_share[first[lane] + k] : 0.0; });
    }
};

// Rows of a table, which are so far apart.
inline Axes pick(const double* table, int64_t stride, const int32_t* row) {
    const double* at[AT_ONCE];
    for (int lane = 0; lane < AT_ONCE; ++lane) at[lane] = table + stride * row[lane];
    return {gather([&](int lane) { return at[lane][0]; }), gather([&](int lane) { return at[lane][1]; }),
            gather([&](int lane) { return at[lane][2]; })};
}

inline void put(double* table, int64_t stride, const int32_t* row, Axes a) {
    alignas(sizeof(VN)) double axes[3][AT_ONCE];
    store(axes[0], a.x), store(axes[1], a.y), store(axes[2], a.z);
    for (int lane = 0; lane < AT_ONCE; ++lane)
        for (int k = 0; k < 3; ++k) table[stride * row[lane] + k] = axes[k][lane];
}

inline void add_cross(Axes a, Axes b, Axes& sum) {
    sum.x += a.y * b.z - a.z * b.y, sum.y += a.z * b.x - a.x * b.z, sum.z += a.x * b.y - a.y * b.x;
}

inline Axes unit(Axes a) {
    const VN length = root(dot(a, a)), zero = every(0.0);
    const IN some = length > TINY;
    const VN scale = 1.0 / (some ? length : every(1.0));
    return {some ? scale * a.x : zero, some ? scale * a.y : zero, some ? scale * a.z : zero};
}

// Area-weighted unit normals now and, of as many places, next; zero where there is none.
void make_normals(const Tree& tree, const Fans& fans, const double* const* pos, int places) {
    const Axes nothing{every(0.0), every(0.0), every(0.0)};
    Axes here[2] = {nothing, nothing}, before[2] = {nothing, nothing}, sum[2] = {nothing, nothing};
    for (int p = 0; p < places; ++p) here[p] = pick(pos[p], 3, fans.vertex);
    for (int32_t k = 0; k < fans.turns; ++k) {
        int32_t corner[AT_ONCE];
        fans.turn(tree, k, corner);
        for (int p = 0; p < places; ++p) {
            const Axes edge = pick(pos[p], 3, corner) - here[p];
            add_cross(before[p], edge, sum[p]);
            before[p] = edge;
        }
    }
    for (int p = 0; p < places; ++p) put(tree.vertex_normal + 3 * p, 6, fans.vertex, unit(sum[p]));
}

// Largest normal curvatures over the edges at vertices, see hood/mesh/geometry.py.
VN bend(const Tree& tree, const Query& query, const Fans& fans) {
    const Axes here = pick(tree.pos, 3, fans.vertex), normal = pick(tree.vertex_normal, 6, fans.vertex);
    VN most = every(0.0);
    for (int32_t k = 0; k < fans.turns; ++k) {
        int32_t corner[AT_ONCE];
        fans.turn(tree, k, corner);
        const Axes edge = pick(tree.pos, 3, corner) - here, turn = pick(tree.vertex_normal, 6, corner) - normal;
        most = greatest(dot(turn, edge) / greatest(dot(edge, edge), every(TINY)), most);
    }
    return least(most, every(query.most_curvature));
}

// The average over the corners of the faces around vertices, each face with the vertex itself.
VN average(const Tree& tree, const double* values, const Fans& fans) {
    VN sum = gather([&](int lane) { return values[fans.vertex[lane]]; }) / 3.0;
    for (int32_t k = 0; k < fans.turns; ++k) {
        int32_t corner[AT_ONCE];
        fans.turn(tree, k, corner);
        sum += fans.share(tree, k) * gather([&](int lane) { return values[corner[lane]]; });
    }
    return sum;
}

// Work on the needed vertices ``begin`` to ``end``, one a lane, by threads.
template <class Work> void for_needed(const Tree& tree, int64_t begin, int64_t end, const Work& work) {
    for_parts(tree.parts, [&](int64_t part) {
        const Range range = range_of(end - begin, part, tree.parts, AT_ONCE);
        for (int64_t i = begin + range.begin; i < begin + range.end; i += AT_ONCE) work(Fans(tree, i, end));
    });
}

inline void need(const Tree& tree, int64_t vertex, int64_t& count) {
    // Without a branch: whether a vertex is new is hard to foresee.
    tree.needed[count] = (int32_t)vertex;
    count += tree.stamp[vertex] != (int32_t)tree.call;
    tree.stamp[vertex] = (int32_t)tree.call;
}

// Lists the vertices that the points were found at, then those around them, ring by ring; how many there are up to each.
std::vector<int64_t> list_needed(const Tree& tree, const Query& query, int64_t rings) {
    int64_t count = 0, begin = 0;
    for (int64_t i = 0; i < query.count; ++i)
        for (int c = 0; c < 3; ++c)
            if (query.bary[3 * i + c] != 0.0) need(tree, tree.faces[3 * query.face[i] + c], count);
    std::vector<int64_t> until{count};
    for (int64_t ring = 0; ring < rings; ++ring) {
        for (const int64_t end = count; begin < end; ++begin)
            for (int32_t i = tree.fan_first[tree.needed[begin]]; i < tree.fan_first[tree.needed[begin] + 1]; ++i)
                need(tree, tree.fan[i], count);
        until.push_back(count);
    }
    return until;
}

// Curvatures at the vertices that the points were found at, of those around them alone: every average takes a ring less.
const double* make_curvatures(const Tree& tree, const Query& query, const std::vector<int64_t>& until) {
    double *now = tree.bulge, *other = now + tree.num_vertices;
    const auto fill = [&](int64_t ring, double* values, const auto& values_at) {
        for_needed(tree, 0, until[ring], [&](const Fans& fans) {
            alignas(sizeof(VN)) double value[AT_ONCE];
            store(value, values_at(fans));
            for (int lane = 0; lane < AT_ONCE; ++lane) values[fans.vertex[lane]] = value[lane];
        });
    };
    fill(query.rounds, now, [&](const Fans& fans) { return bend(tree, query, fans); });
    for (int64_t ring = query.rounds - 1; ring >= 0; --ring, std::swap(now, other))
        fill(ring, other, [&](const Fans& fans) { return average(tree, now, fans); });
    return now;
}

// Where the i-th point of a face is, now and next, and the normals there.
void interpolate(const Tree& tree, const Query& query, const double* curvature, int64_t i) {
    Vec where{0.0, 0.0, 0.0}, next_where = where, up = where, next_up = where;
    double bulge = 0.0;
    for (int c = 0; c < 3; ++c) {
        const int64_t vertex = tree.faces[3 * query.face[i] + c];
        const double share = query.bary[3 * i + c], *normals = tree.vertex_normal + 6 * vertex;
        where = where + share * at(tree.pos, vertex);
        next_where = next_where + share * at(query.next_pos, vertex);
        if (share == 0.0) continue;
        up = up + share * at(normals, 0);
        next_up = next_up + share * at(normals, 1);
        if (curvature) bulge += share * curvature[vertex];
    }
    put(query.point + 3 * i, where), put(query.normal + 3 * i, unit(up));
    put(query.next_point + 3 * i, next_where), put(query.next_normal + 3 * i, unit(next_up));
    if (curvature) query.curvature[i] = bulge;
}

// What is known of the points that were found.
void describe(const Tree& tree, const Query& query) {
    const std::vector<int64_t> until = list_needed(tree, query, query.curvature ? query.rounds + 1 : 0);
    const double* const pos[2] = {tree.pos, query.next_pos};
    for_needed(tree, 0, until.front(), [&](const Fans& fans) { make_normals(tree, fans, pos, 2); });
    for_needed(tree, until.front(), until.back(), [&](const Fans& fans) { make_normals(tree, fans, pos, 1); });
    const double* curvature = query.curvature ? make_curvatures(tree, query, until) : nullptr;
    for_parts(tree.parts, [&](int64_t part) {
        const Range range = range_of(query.count, part, tree.parts);
        for (int64_t i = range.begin; i < range.end; ++i) interpolate(tree, query, curvature, i);
    });
}

// Unit normals of the faces of a leaf.
void fit_normals(const Tree& tree, int64_t leaf) {
    float* normals = tree.leaf_normals + 3 * WIDE * leaf;
    for (int i = 0; i < WIDE; i += AT_ONCE) {
        const double* table = tree.corners + 9 * WIDE * leaf + i;
        const Axes a = load_axes(table), u = load_axes(table + 3 * WIDE) - a, v = load_axes(table + 6 * WIDE) - a;
        Axes normal = everywhere({0.0, 0.0, 0.0});
        add_cross(u, v, normal);
        normal = unit(normal);
        store(normals + i, __builtin_convertvector(normal.x, FN)), store(normals + WIDE + i, __builtin_convertvector(normal.y, FN));
        store(normals + 2 * WIDE + i, __builtin_convertvector(normal.z, FN));
    }
}

// The least of eight numbers; passes over what is not a number.
inline float least_of(const float* p) {
    const F4 low = least(load<F4>(p), least(load<F4>(p + 4), F4{} + INFINITY));
    return std::min(std::min(low[0], low[2]), std::min(low[1], low[3]));
}
inline float most_of(const float* p) {
    const F4 high = greatest(load<F4>(p), greatest(load<F4>(p + 4), F4{} - INFINITY));
    return std::max(std::max(high[0], high[2]), std::max(high[1], high[3]));
}

// Boxes of groups, from those of leaves up: those begin with ``low`` and ``high`` (3, 8), rows of so many numbers. Lanes without
// anything in them are not a number.
void fit_levels(int64_t num_leaves, const float* low, const float* high, int64_t row, float* boxes) {
    const Levels levels(num_leaves);
    int64_t size = num_leaves;
    for (int level = 0; level < levels.count; ++level) {
        float* into = boxes + 6 * WIDE * levels.first[level];
        const int64_t next = levels.first[level + 1] - levels.first[level];
        std::fill(into + 6 * WIDE * (next - 1), into + 6 * WIDE * next, NAN);
        for (int64_t i = 0; i < size; ++i)
            for (int k = 0; k < 3; ++k) {
                float* side = into + WIDE * (6 * (i / WIDE) + k) + i % WIDE;
                side[0] = least_of(low + row * i + WIDE * k), side[3 * WIDE] = most_of(high + row * i + WIDE * k);
            }
        low = into, high = into + 3 * WIDE, row = 6 * WIDE, size = next;
    }
}

// Those of all faces, and boxes around them; nothing to do where they are of this fit.
void fit_all_normals(Tree& tree) {
    if (tree.normals_of == tree.fits) return;
    tree.normals_of = tree.fits;
    for (int64_t leaf = 0; leaf < tree.num_leaves; ++leaf) fit_normals(tree, leaf);
    fit_levels(tree.num_leaves, tree.leaf_normals, tree.leaf_normals, 3 * WIDE, tree.normal_boxes);
}

// The least product of a normal with n in every lane; not a number where there is no box.
inline F8 least_turn(const float* box, Vec n) {
    const float x = (float)n.x, y = (float)n.y, z = (float)n.z;
    return least(load<F8>(box) * x, load<F8>(box + 3 * WIDE) * x) + least(load<F8>(box + WIDE) * y, load<F8>(box + 4 * WIDE) * y) +
           least(load<F8>(box + 2 * WIDE) * z, load<F8>(box + 5 * WIDE) * z);
}

void finish(const Tree& tree, const Query& query, int64_t i, const Walk& walk) {
    const Found closest = walk.face, nearest = first_of(walk.vertices);
    // A surface without a finite place has neither.
    const int64_t face = closest.number < NONE ? (int64_t)closest.number : tree.order[0];
    query.face[i] = face;
    query.vertex[i] = nearest.number < NONE ? (int64_t)nearest.number : tree.faces[3 * face];
    query.vertex_dist[i] = std::sqrt(nearest.dist_sq);
    const int64_t* corner = tree.faces + 3 * face;
    double* bary = query.bary + 3 * i;
    Vec offset;
    closest_on_triangle(walk.p, at(tree.pos, corner[0]), at(tree.pos, corner[1]), at(tree.pos, corner[2]), bary, &offset);
    const double side = dot(offset, pseudonormal(tree, face, bary));
    query.dist[i] = (side < 0.0 ? -1.0 : 1.0) * std::sqrt(closest.dist_sq);
}

inline Vec ahead_of(const Matched& matched, const Query& query, int64_t i) {
    return at(query.points, i) + matched.ahead * at(matched.normal, i);
}

// Which points from ``begin`` on, no more than a batch, may be nearer to a face that is turned than to the skin that they were matched
// with, from a place ahead of them.
void find_turned(const Tree& tree, const Levels& levels, const Matched& matched, const Query& query, int64_t begin, int64_t end, uint8_t* found) {
    Walk walks[MOST];
    Visit *from = tree.visits, *to = tree.next_visits;
    int64_t left = 0;
    for (int64_t i = begin; i < end; ++i) {
        found[i] = 0;
        if (!matched.valid[i] || !(std::fabs(matched.dist[i]) < matched.near)) continue;
        Walk& walk = walks[i - begin];
        const Vec place = ahead_of(matched, query, i), own = place - at(matched.point, i), local = place - at(tree.origin, 0);
        place_walk(tree, walk, place);
        walk.limit = limit_of(dot(own, own), tree.size_sq + dot(local, local));
        from[left++] = (Visit)(i - begin);
    }
    // Faces that are turned by a little less are no harm: what is found is looked at again.
    const float cosine = (float)matched.cosine + 1e-5f;
    for (int level = levels.count - 1; level >= 0; --level) {
        int64_t listed = 0;
        for (int64_t k = 0; k < left; ++k) {
            const int64_t group = levels.first[level] + (int64_t)(from[k] / ITEM), q = (int64_t)(from[k] % ITEM);
            const F8 turn = least_turn(tree.normal_boxes + 6 * WIDE * group, at(matched.normal, begin + q));
            list_lanes((boxes_dist_sq(tree.boxes + 6 * WIDE * group, walks[q]) <= walks[q].limit) & (turn < cosine), first_below(from[k]), to, listed);
        }
        std::swap(from, to);
        left = listed;
    }
    for (int64_t k = 0; k < left; ++k) {
        const int64_t leaf = (int64_t)(from[k] / ITEM), q = (int64_t)(from[k] % ITEM);
        const Vec n = at(matched.normal, begin + q);
        const float* normals = tree.leaf_normals + 3 * WIDE * leaf;
        const F8 turn = load<F8>(normals) * (float)n.x + load<F8>(normals + WIDE) * (float)n.y + load<F8>(normals + 2 * WIDE) * (float)n.z;
        Visit some[WIDE + 1];
        int64_t faces = 0;
        list_lanes((boxes_dist_sq(tree.face_boxes + 6 * WIDE * leaf, walks[q]) <= walks[q].limit) & (turn < cosine), 0, some, faces);
        found[begin + q] |= faces > 0;
    }
}

// Whether what was found k-th is another side than that of the i-th point. Of a sharp edge only the faces are turned, of a bulge
// between two faces only the normals on the way.
bool is_other(const Tree& tree, const Matched& matched, const Query& found, int64_t k, int64_t i) {
    const int64_t* corner = tree.faces + 3 * found.face[k];
    const Vec normal = at(matched.normal, i), here = at(tree.pos, corner[0]);
    const Vec of_face = unit(cross(at(tree.pos, corner[1]) - here, at(tree.pos, corner[2]) - here));
    const bool turned = dot(of_face, normal) < matched.cosine && dot(at(found.normal, k), normal) < matched.cosine;
    const bool in_front = dot(at(found.point, k) - at(matched.point, i), normal) > -matched.behind;
    return turned && in_front && std::fabs(found.dist[k]) <= matched.ahead + matched.near;
}

// Work on the points of a part, batch by batch, with lists of its own.
template <class Work> void for_batches(Tree tree, int64_t count, int64_t part, const Work& work) {
    for (Visit** list : {&tree.visits, &tree.next_visits, &tree.near}) *list += (tree.batch * tree.num_leaves + WIDE) * part;
    const Range range = range_of(count, part, tree.parts, tree.batch);
    for (int64_t i = range.begin; i < range.end; i += tree.batch) work(tree, i, std::min(i + tree.batch, range.end));
}

void search(const Tree& tree, const Query& query, int64_t begin, int64_t end) {
    const Levels levels(tree.num_leaves);
    Walk walks[MOST];
    bool finite[MOST];
    for (int64_t i = begin; i < end; ++i) {
        Walk& walk = walks[i - begin];
        const Vec p = at(query.points, i);
        finite[i - begin] = std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z);
        place_walk(tree, walk, finite[i - begin] ? p : Vec{0.0, 0.0, 0.0});
        walk.leaf = query.hint ? tree.place[query.hint[i]] / WIDE : likely_leaf(tree, levels, walk);
        for (int k = 0; k < 9; ++k) __builtin_prefetch(tree.corners + WIDE * (9 * walk.leaf + k));
        __builtin_prefetch(tree.number + WIDE * walk.leaf);
    }
    for (int64_t i = begin; i < end; ++i) begin_at(tree, walks[i - begin], walks[i - begin].leaf);
    walk_together(tree, levels, walks, (int32_t)(end - begin));
    for (int64_t i = begin; i < end; ++i) {
        finish(tree, query, i, walks[i - begin]);
        if (!finite[i - begin]) query.dist[i] = NAN;
    }
}

// Gives every vertex to one of the leaves around it, to that which has the fewest, and lists those of each leaf.
void share_vertices(Tree& tree) {
    int32_t* count = tree.block_first + 1;
    std::fill(count, count + tree.num_leaves, 0);
    for (int64_t vertex = 0; vertex < tree.num_vertices; ++vertex) {
        int64_t owner = -1;
        for (int64_t i = 0; i < tree.valence[vertex]; ++i) {
            const int64_t place = tree.place[tree.around[tree.first[vertex] + i]], leaf = place / WIDE;
            if (place >= 0 && (owner < 0 || count[leaf] < count[owner])) owner = leaf;
        }
        tree.stamp[vertex] = (int32_t)owner;
        if (owner >= 0) ++count[owner];
    }
    tree.block_first[0] = 0;
    for (int64_t leaf = 0; leaf < tree.num_leaves; ++leaf) count[leaf] = tree.block_first[leaf] + (count[leaf] + BLOCK - 1) / BLOCK;
    tree.num_blocks = tree.block_first[tree.num_leaves];
    std::fill(tree.block_vertex, tree.block_vertex + BLOCK * tree.num_blocks, -1);
    for (int64_t vertex = 0; vertex < tree.num_vertices; ++vertex) {
        if (tree.stamp[vertex] < 0) continue;
        int32_t* slot = tree.block_vertex + BLOCK * (int64_t)tree.block_first[tree.stamp[vertex]];
        while (*slot >= 0) ++slot;
        *slot = (int32_t)vertex;
    }
    for (int64_t i = 0; i < BLOCK * tree.num_blocks; ++i)
        if (tree.block_vertex[i] < 0) tree.block_vertex[i] = tree.block_vertex[i - 1];
}

// Lists the corners of the faces around a vertex in turn, from one rim to the other or once around. Where fans meet in a vertex
// alone it stands itself between them.
void list_fan(Tree& tree, int64_t vertex, std::vector<std::array<int32_t, 2>>& left) {
    left.clear();
    for (int64_t i = tree.first[vertex]; i < tree.first[vertex] + tree.valence[vertex]; ++i) {
        const int64_t* c = tree.faces + 3 * tree.around[i];
        const int own = c[0] == vertex ? 0 : c[1] == vertex ? 1 : 2;
        left.push_back({(int32_t)c[(own + 1) % 3], (int32_t)c[(own + 2) % 3]});
    }
    const double share = 1.0 / (3.0 * (double)tree.valence[vertex]);
    const int32_t begin = tree.fan_first[vertex];
    int32_t end = begin;
    const auto append = [&](int32_t corner, double count) { tree.fan[end] = corner, tree.fan_share[end++] = count; };
    const auto follows = [&](size_t i, int32_t corner) { return left[i][0] == corner; };
    while (!left.empty()) {
        size_t next = 0;
        for (size_t i = 0; i < left.size(); ++i) {
            bool begins = true;
            for (const auto& face : left) begins = begins && face[1] != left[i][0];
            if (begins) {
                next = i;
                break;
            }
        }
        if (end > begin) append((int32_t)vertex, 0.0);
        append(left[next][0], 0.0);
        while (next < left.size()) {
            const int32_t corner = left[next][1];
            tree.fan_share[end - 1] += share;
            append(corner, share);
            left.erase(left.begin() + next);
            for (next = 0; next < left.size() && !follows(next, corner);) ++next;
        }
    }
    tree.fan_first[vertex + 1] = end;
}

// Widens the box from low to high, lane by lane; passes over what is not a number.
inline void widen(VN value, VN& low, VN& high) { low = least(value, low), high = greatest(value, high); }

// Middle and size of everything.
void locate(Tree& tree) {
    tree.size_sq = 0.0;
    for (int k = 0; k < 3; ++k) {
        VN low = every(INFINITY), high = every(-INFINITY);
        for (int64_t block = 0; block < tree.num_blocks; ++block)
            for (int i = 0; i < BLOCK; i += AT_ONCE) widen(load<VN>(tree.block_pos + BLOCK * (3 * block + k) + i), low, high);
        const double begin = least_lane(low), end = -least_lane(-high), middle = 0.5 * (begin + end);
        tree.origin[k] = std::isfinite(middle) ? middle : 0.0;
        tree.size_sq += (end - begin) * (end - begin);
    }
}

// Boxes of the faces, and of groups.
void fit_boxes(Tree& tree) {
    for (int64_t leaf = 0; leaf < tree.num_leaves; ++leaf)
        for (int k = 0; k < 3; ++k)
            for (int i = 0; i < WIDE; i += AT_ONCE) {
                VN low = every(INFINITY), high = every(-INFINITY);
                for (int c = 0; c < 3; ++c) widen(load<VN>(tree.corners + WIDE * (9 * leaf + 3 * c + k) + i), low, high);
                float* box = tree.face_boxes + WIDE * (6 * leaf + k) + i;
                store(box, __builtin_convertvector(low - tree.origin[k], FN));
                store(box + 3 * WIDE, __builtin_convertvector(high - tree.origin[k], FN));
            }
    fit_levels(tree.num_leaves, tree.face_boxes, tree.face_boxes + 3 * WIDE, 6 * WIDE, tree.boxes);
}

// The turn [rad] that takes points nearest to others about their middle, from sums Σ s eᵀ (3, 3): Horn's matrix, whose eigenvector
// of the largest eigenvalue is its quaternion, by Jacobi's rotations.
double turn_of(const double (&s)[3][3]) {
    double n[4][4] = {}, q[4][4] = {};
    n[0][0] = s[0][0] + s[1][1] + s[2][2];
    for (int a = 0; a < 3; ++a) {
        const int b = (a + 1) % 3, c = (a + 2) % 3;
        n[0][a + 1] = n[a + 1][0] = s[b][c] - s[c][b];
        n[a + 1][a + 1] = s[a][a] - s[b][b] - s[c][c];
        n[a + 1][b + 1] = n[b + 1][a + 1] = s[a][b] + s[b][a];
    }
    for (int i = 0; i < 4; ++i) q[i][i] = 1.0;
    for (int sweep = 0; sweep < 16; ++sweep) {
        double off = 0.0, on = 0.0;
        for (int i = 0; i < 4; ++i)
            for (int j = 0; j < 4; ++j) (i == j ? on : off) += n[i][j] * n[i][j];
        if (!(off > EPS * EPS * on)) break;
        for (int i = 0; i < 3; ++i)
            for (int j = i + 1; j < 4; ++j) {
                const double angle = 0.5 * std::atan2(2.0 * n[i][j], n[i][i] - n[j][j]);
                const double c = std::cos(angle), d = std::sin(angle);
                for (int k = 0; k < 4; ++k) {
                    const double u = n[k][i], v = n[k][j], x = q[k][i], y = q[k][j];
                    n[k][i] = c * u + d * v, n[k][j] = c * v - d * u;
                    q[k][i] = c * x + d * y, q[k][j] = c * y - d * x;
                }
                for (int k = 0; k < 4; ++k) {
                    const double u = n[i][k], v = n[j][k];
                    n[i][k] = c * u + d * v, n[j][k] = c * v - d * u;
                }
            }
    }
    int most = 0;
    for (int i = 1; i < 4; ++i)
        if (n[i][i] > n[most][most]) most = i;
    const double x = q[1][most], y = q[2][most], z = q[3][most];
    return 2.0 * std::atan2(std::sqrt(x * x + y * y + z * z), std::abs(q[0][most]));
}

}  // namespace

extern "C" {

// How points (N, 3) move as one: the turn about their middle [rad], and the longest way of one of them.
void surface_moved(int64_t count, const double* start, const double* end, double* found) {
    double from[3] = {}, to[3] = {}, sums[3][3] = {}, way_sq = 0.0;
    for (int64_t i = 0; i < count; ++i) {
        double sq = 0.0;
        for (int k = 0; k < 3; ++k) {
            const double s = start[3 * i + k], e = end[3 * i + k];
            from[k] += s / (double)count, to[k] += e / (double)count, sq += (e - s) * (e - s);
        }
        way_sq = sq > way_sq ? sq : way_sq;
    }
    for (int64_t i = 0; i < count; ++i)
        for (int a = 0; a < 3; ++a)
            for (int b = 0; b < 3; ++b) sums[a][b] += (start[3 * i + a] - from[a]) * (end[3 * i + b] - to[b]);
    found[0] = turn_of(sums), found[1] = std::sqrt(way_sq);
}

// Everything that depends on the topology alone, from centres (G, 3) of the faces; ``order`` holds those in the tree.
void surface_build(Tree* tree, const double* centre) {
    tree->num_leaves = (tree->num_faces + WIDE - 1) / WIDE;
    order_leaves(tree->order, (int32_t)tree->num_faces, WIDE, centre);
    for (int64_t i = tree->num_faces; i < WIDE * tree->num_leaves; ++i) tree->order[i] = tree->order[tree->num_faces - 1];
    for (int64_t i = 0; i < WIDE * tree->num_leaves; ++i) {
        tree->number[i] = tree->order[i];
        for (int c = 0; c < 3; ++c)
            tree->corner_of[WIDE * (3 * (i / WIDE) + c) + i % WIDE] = (int32_t)tree->faces[3 * (int64_t)tree->order[i] + c];
    }
    for (int64_t i = 0; i < tree->num_faces; ++i) tree->place[tree->order[i]] = (int32_t)i;
    share_vertices(*tree);
    std::fill(tree->stamp, tree->stamp + tree->num_vertices, 0);
    std::vector<std::array<int32_t, 2>> left;
    for (int64_t vertex = 0; vertex < tree->num_vertices; ++vertex) list_fan(*tree, vertex, left);
    for (int64_t i = 0; i < BLOCK * tree->num_blocks; ++i) tree->block_number[i] = tree->block_vertex[i];
}

// Takes up where the vertices are now.
void surface_refit(Tree* tree) {
    ++tree->call, ++tree->fits;
    for (int64_t leaf = 0; leaf < tree->num_leaves; ++leaf) fill_corners(*tree, leaf, tree->pos, tree->corners + 9 * WIDE * leaf);
    for (int64_t i = 0; i < BLOCK * tree->num_blocks; ++i)
        for (int k = 0; k < 3; ++k)
            tree->block_pos[3 * BLOCK * (i / BLOCK) + BLOCK * k + i % BLOCK] = tree->pos[3 * (int64_t)tree->block_vertex[i] + k];
    locate(*tree);
    fit_boxes(*tree);
}

// Makes ready for another search where the vertices are as they were.
void surface_again(Tree* tree) { ++tree->call; }

// Curvatures of vertices, see hood/mesh/geometry.py; ``memory`` is (vertices, 3), ``of_face`` (faces).
void surface_curvature(int64_t num_faces, int64_t num_edges, int64_t num_vertices, const int64_t* faces, const int64_t* edges,
                       const int64_t* around, const int64_t* first, const int64_t* valence, const double* pos, double* memory,
                       double* of_face, double* curvature, double most, int64_t rounds) {
    std::fill(memory, memory + 3 * num_vertices, 0.0);
    std::fill(curvature, curvature + num_vertices, 0.0);
    for (int64_t face = 0; face < num_faces; ++face) {
        const int64_t* c = faces + 3 * face;
        const Vec here = at(pos, c[0]), normal = cross(at(pos, c[1]) - here, at(pos, c[2]) - here);
        for (int k = 0; k < 3; ++k) put(memory + 3 * c[k], at(memory, c[k]) + normal);
    }
    for (int64_t i = 0; i < num_vertices; ++i) {
        const Vec sum = at(memory, i);
        const double length = std::sqrt(dot(sum, sum));
        put(memory + 3 * i, length > TINY ? (1.0 / length) * sum : Vec{0.0, 0.0, 0.0});
    }
    for (int64_t edge = 0; edge < num_edges; ++edge) {
        const int64_t i = edges[2 * edge], j = edges[2 * edge + 1];
        const Vec along = at(pos, j) - at(pos, i);
        const double bend = std::min(dot(at(memory, j) - at(memory, i), along) / std::max(dot(along, along), TINY), most);
        // Not-a-number is no curvature.
        if (bend > curvature[i]) curvature[i] = bend;
        if (bend > curvature[j]) curvature[j] = bend;
    }
    for (int64_t round = 0; round < rounds; ++round) {
        for (int64_t face = 0; face < num_faces; ++face) {
            const int64_t* c = faces + 3 * face;
            of_face[face] = (curvature[c[0]] + curvature[c[1]] + curvature[c[2]]) / 3.0;
        }
        for (int64_t i = 0; i < num_vertices; ++i) {
            double sum = 0.0;
            for (int64_t k = first[i]; k < first[i] + valence[i]; ++k) sum += of_face[around[k]];
            curvature[i] = sum / (double)std::max(valence[i], (int64_t)1);
        }
    }
}

// The faces nearest to the points, where on them, and how far away.
void surface_find(const Tree* tree, const Query* query) {
    for_parts(tree->parts, [&](int64_t part) {
        for_batches(*tree, query->count, part, [&](const Tree& own, int64_t begin, int64_t end) { search(own, *query, begin, end); });
    });
}

// What is known of places that have been found.
void surface_describe(const Tree* tree, const Query* query) { describe(*tree, *query); }

// The other side of folds: of points whose nearest surface points are known, the rows of those that have one are filled in, and
// ``found`` (N) says which they are. What it is, see hood/contact/contact.py.
void surface_folds(Tree* tree, const Matched* matched, const Query* all, uint8_t* found) {
    fit_all_normals(*tree);
    for_parts(tree->parts, [&](int64_t part) {
        const Levels levels(tree->num_leaves);
        for_batches(*tree, all->count, part, [&](const Tree& own, int64_t begin, int64_t end) { find_turned(own, levels, *matched, *all, begin, end, found); });
    });
    std::vector<int64_t> rows;
    for (int64_t i = 0; i < all->count; ++i)
        if (found[i]) rows.push_back(i);
    if (rows.empty()) return;
    // A search for these alone.
    const int64_t count = (int64_t)rows.size();
    std::vector<int64_t> whole(2 * count);
    std::vector<double> real(21 * count);
    Query query = *all;
    query.count = count, query.hint = nullptr;
    query.vertex = whole.data(), query.face = query.vertex + count;
    double* next = real.data();
    const auto take = [&](int64_t width) { return std::exchange(next, next + width * count); };
    double* places = take(3);
    query.points = places, query.vertex_dist = take(1), query.dist = take(1), query.curvature = take(1);
    query.bary = take(3), query.point = take(3), query.normal = take(3), query.next_point = take(3), query.next_normal = take(3);
    for (int64_t k = 0; k < count; ++k) put(places + 3 * k, ahead_of(*matched, *all, rows[k]));
    ++tree->call;
    surface_find(tree, &query);
    surface_describe(tree, &query);
    for (int64_t k = 0; k < count; ++k) {
        const int64_t i = rows[k];
        found[i] = is_other(*tree, *matched, query, k, i);
        if (!found[i]) continue;
        all->vertex[i] = query.vertex[k], all->face[i] = query.face[k], all->vertex_dist[i] = query.vertex_dist[k];
        all->curvature[i] = query.curvature[k];
        for (int c = 0; c < 3; ++c) all->bary[3 * i + c] = query.bary[3 * k + c];
        put(all->point + 3 * i, at(query.point, k)), put(all->normal + 3 * i, at(query.normal, k));
        put(all->next_point + 3 * i, at(query.next_point, k)), put(all->next_normal + 3 * i, at(query.next_normal, k));
        all->dist[i] = dot(at(all->points, i) - at(query.point, k), at(query.normal, k));
    }
}
}
