// Closest points on a triangle surface by a tree of boxes: built once for a topology, refitted to the positions of every call.
//
// The search is exact, and its result does not depend on the tree, on where it starts, or on the order of faces visited: of faces
// at the same distance the one with the lowest number is taken. Everything is computed in float64.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>

namespace {

constexpr int WIDE = 8;       // children of a node, faces of a leaf
constexpr double EPS = 2.220446049250313e-16, TINY = 2.2250738585072014e-308;
constexpr double SLACK = 1.0 + 1e-12;  // boxes and faces round differently

typedef double V8 __attribute__((vector_size(64)));
typedef decltype(V8{} < V8{}) I8;

inline V8 load(const double* p) {
    V8 v;
    std::memcpy(&v, p, sizeof(V8));
    return v;
}
inline V8 all(double x) { return V8{x, x, x, x, x, x, x, x}; }
inline V8 least(V8 a, V8 b) { return a < b ? a : b; }
inline V8 greatest(V8 a, V8 b) { return a > b ? a : b; }

struct Vec {
    double x, y, z;
};
inline Vec operator-(Vec a, Vec b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline Vec operator+(Vec a, Vec b) { return {a.x + b.x, a.y + b.y, a.z + b.z}; }
inline Vec operator*(double s, Vec a) { return {s * a.x, s * a.y, s * a.z}; }
inline double dot(Vec a, Vec b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Vec cross(Vec a, Vec b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline Vec at(const double* p, int64_t i) { return {p[3 * i], p[3 * i + 1], p[3 * i + 2]}; }
inline double clamp(double v) { return v < 0.0 ? 0.0 : v > 1.0 ? 1.0 : v; }

}  // namespace

extern "C" {

struct Tree {
    int64_t num_faces, num_nodes, num_leaves;
    const int64_t* faces;  // (G, 3)
    int32_t* order;        // (F) those of them that are in the tree, leaf after leaf
    int32_t* children;     // (M, 8) nodes, or -1 - leaf; the node itself where there is none
    int32_t* leaves;       // (L, 2) first and last of a leaf in the order
    double* boxes;         // (M, 6, 8) least and greatest corners of the children
    double* corners;       // (L, 9, 8) corners of the faces of a leaf; its last one is repeated
    double* pos;           // (W, 3) m, the vertices of this call
    // How faces hang together, see hood.mesh.proximity.Incidence.
    const int64_t *around, *first, *valence;  // (3G), (W), (W)
    const int64_t *face_edges, *edge_faces;   // (G, 3), (E, M) with -1
    int64_t edge_width;
};

struct Query {
    int64_t count;
    const double* points;      // (N, 3)
    const double* next_pos;    // (W, 3) m, where the surface goes
    int32_t* guess;            // (N) faces to begin with; those found come back
    int64_t *vertex, *face;    // (N)
    double *vertex_dist, *bary, *dist;                         // (N), (N, 3), (N)
    double *point, *normal, *next_point, *next_normal;         // (N, 3) each
};
}

namespace {

struct Hit {
    double dist_sq;
    int64_t face;
    double bary[3];
    Vec offset;
};

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

inline void try_face(const Tree& tree, Vec p, int64_t face, Hit& best) {
    const int64_t* corner = tree.faces + 3 * face;
    double bary[3];
    Vec offset;
    closest_on_triangle(p, at(tree.pos, corner[0]), at(tree.pos, corner[1]), at(tree.pos, corner[2]), bary, &offset);
    const double dist_sq = dot(offset, offset);
    if (dist_sq < best.dist_sq || (dist_sq == best.dist_sq && face < best.face)) {
        best.dist_sq = dist_sq, best.face = face, best.offset = offset;
        std::memcpy(best.bary, bary, sizeof(bary));
    }
}

struct Axes {
    V8 x, y, z;
};
inline Axes operator-(Axes a, Axes b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline V8 dot(Axes a, Axes b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Axes along(Axes a, V8 s, Axes b) { return {a.x - s * b.x, a.y - s * b.y, a.z - s * b.z}; }
inline V8 share(V8 value, V8 size) {
    return least(greatest(value / greatest(size, all(TINY)), all(0.0)), all(1.0));
}

// Squared distances from q, relative to the first corner, to eight triangles: what closest_on_triangle finds.
inline V8 triangle_dist_sq(Axes q, Axes u, Axes v) {
    const V8 zero = all(0.0), one = all(1.0), uu = dot(u, u), vv = dot(v, v), uv = dot(u, v), pu = dot(q, u), pv = dot(q, v);
    const V8 det = uu * vv - uv * uv;
    const I8 regular = det > EPS * uu * vv;
    const V8 safe = regular ? det : one, s = (vv * pu - uv * pv) / safe, t = (uu * pv - uv * pu) / safe;
    const I8 inside = regular & (s >= zero) & (t >= zero) & (s + t <= one);
    const Axes w = v - u, r = q - u, free = along(along(q, s, u), t, v);
    const Axes by_u = along(q, share(pu, uu), u), by_v = along(q, share(pv, vv), v), by_w = along(r, share(dot(r, w), dot(w, w)), w);
    return inside ? dot(free, free) : least(dot(by_u, by_u), least(dot(by_v, by_v), dot(by_w, by_w)));
}

struct Nearest {
    double dist_sq;
    int64_t vertex;
};

inline void try_vertex(Vec p, const double* pos, int64_t vertex, Nearest& nearest) {
    const Vec gap = p - at(pos, vertex);
    const double dist_sq = dot(gap, gap);
    if (dist_sq < nearest.dist_sq || (dist_sq == nearest.dist_sq && vertex < nearest.vertex)) nearest = {dist_sq, vertex};
}

// Faces and vertices of a leaf that may be the closest; what decides is computed for each of them in the same way as ever.
inline void try_leaf(const Tree& tree, Vec p, int64_t leaf, Hit& best, Nearest& nearest) {
    const double* table = tree.corners + 9 * WIDE * leaf;
    Axes corner[3];
    for (int c = 0; c < 3; ++c)
        corner[c] = {load(table + WIDE * (3 * c)), load(table + WIDE * (3 * c + 1)), load(table + WIDE * (3 * c + 2))};
    const Axes here{all(p.x), all(p.y), all(p.z)};
    const V8 found = triangle_dist_sq(here - corner[0], corner[1] - corner[0], corner[2] - corner[0]);
    const int32_t begin = tree.leaves[2 * leaf], count = tree.leaves[2 * leaf + 1] - begin;
    for (int32_t i = 0; i < count; ++i)
        if (found[i] <= best.dist_sq * SLACK) try_face(tree, p, tree.order[begin + i], best);
    for (int c = 0; c < 3; ++c) {
        const Axes gap = here - corner[c];
        const V8 away = dot(gap, gap);
        for (int32_t i = 0; i < count; ++i)
            if (away[i] <= nearest.dist_sq * SLACK) try_vertex(p, tree.pos, tree.faces[3 * (int64_t)tree.order[begin + i] + c], nearest);
    }
}

// Visits every leaf that may hold the closest face or vertex, near ones first.
void descend(const Tree& tree, Vec p, Hit& best, Nearest& nearest) {
    int32_t stack[128];
    double reach[128];
    int size = 1;
    stack[0] = tree.num_nodes ? 0 : -1;
    reach[0] = 0.0;
    while (size) {
        --size;
        // A vertex is never nearer than the surface.
        if (reach[size] > nearest.dist_sq * SLACK) continue;
        const int64_t node = stack[size];
        if (node < 0) {
            try_leaf(tree, p, -1 - node, best, nearest);
            continue;
        }
        const double* box = tree.boxes + 6 * WIDE * node;
        const V8 zero = all(0.0);
        const V8 dx = greatest(greatest(load(box) - p.x, p.x - load(box + 3 * WIDE)), zero);
        const V8 dy = greatest(greatest(load(box + WIDE) - p.y, p.y - load(box + 4 * WIDE)), zero);
        const V8 dz = greatest(greatest(load(box + 2 * WIDE) - p.z, p.z - load(box + 5 * WIDE)), zero);
        const V8 away = dx * dx + dy * dy + dz * dz;
        const double limit = nearest.dist_sq * SLACK;
        const int bottom = size;
        for (int i = 0; i < WIDE; ++i) {
            if (!(away[i] <= limit) || tree.children[WIDE * node + i] == node) continue;
            int place = size++;
            for (; place > bottom && reach[place - 1] < away[i]; --place) {
                reach[place] = reach[place - 1];
                stack[place] = stack[place - 1];
            }
            reach[place] = away[i];
            stack[place] = tree.children[WIDE * node + i];
        }
    }
}

inline Vec face_cross(const Tree& tree, const double* pos, int64_t face) {
    const int64_t* c = tree.faces + 3 * face;
    const Vec a = at(pos, c[0]);
    return cross(at(pos, c[1]) - a, at(pos, c[2]) - a);
}

inline Vec unit(Vec a) {
    const double length = std::sqrt(dot(a, a));
    return (1.0 / std::max(length, TINY)) * a;
}

// Angle-weighted pseudonormal, not normalised, at a point of a face.
Vec pseudonormal(const Tree& tree, int64_t face, const double* bary) {
    const int zeros = (bary[0] == 0.0) + (bary[1] == 0.0) + (bary[2] == 0.0);
    Vec sum{0.0, 0.0, 0.0};
    if (zeros == 0) return unit(face_cross(tree, tree.pos, face));
    if (zeros == 1) {
        const int corner = bary[0] == 0.0 ? 0 : bary[1] == 0.0 ? 1 : 2;
        const int64_t* faces = tree.edge_faces + tree.edge_width * tree.face_edges[3 * face + corner];
        for (int64_t i = 0; i < tree.edge_width; ++i)
            if (faces[i] >= 0) sum = sum + unit(face_cross(tree, tree.pos, faces[i]));
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

// Area-weighted unit normal at a vertex; zero where there is none.
Vec vertex_normal(const Tree& tree, const double* pos, int64_t vertex) {
    Vec sum{0.0, 0.0, 0.0};
    for (int64_t i = 0; i < tree.valence[vertex]; ++i) sum = sum + face_cross(tree, pos, tree.around[tree.first[vertex] + i]);
    const double length = std::sqrt(dot(sum, sum));
    return length > TINY ? (1.0 / length) * sum : Vec{0.0, 0.0, 0.0};
}

void interpolate(const Tree& tree, const double* pos, int64_t face, const double* bary, double* point, double* normal) {
    Vec where{0.0, 0.0, 0.0}, up{0.0, 0.0, 0.0};
    for (int c = 0; c < 3; ++c) {
        const int64_t vertex = tree.faces[3 * face + c];
        where = where + bary[c] * at(pos, vertex);
        if (bary[c] != 0.0) up = up + bary[c] * vertex_normal(tree, pos, vertex);
    }
    up = unit(up);
    point[0] = where.x, point[1] = where.y, point[2] = where.z;
    normal[0] = up.x, normal[1] = up.y, normal[2] = up.z;
}

void search(const Tree& tree, const Query& query, int64_t i) {
    Vec p = at(query.points, i);
    const bool finite = std::isfinite(p.x) && std::isfinite(p.y) && std::isfinite(p.z);
    if (!finite) p = {0.0, 0.0, 0.0};
    Hit best{INFINITY, INT64_MAX, {1.0, 0.0, 0.0}, {0.0, 0.0, 0.0}};
    Nearest nearest{INFINITY, INT64_MAX};
    const int64_t guess = query.guess[i] >= 0 ? query.guess[i] : tree.order[0];
    try_face(tree, p, guess, best);
    for (int c = 0; c < 3; ++c) try_vertex(p, tree.pos, tree.faces[3 * guess + c], nearest);
    descend(tree, p, best, nearest);
    if (best.face == INT64_MAX) best.face = guess, nearest.vertex = tree.faces[3 * guess];  // a surface without a finite place
    query.guess[i] = (int32_t)best.face;
    query.face[i] = best.face;
    query.vertex[i] = nearest.vertex;
    query.vertex_dist[i] = std::sqrt(nearest.dist_sq);
    std::memcpy(query.bary + 3 * i, best.bary, sizeof(best.bary));
    const double side = dot(best.offset, pseudonormal(tree, best.face, best.bary));
    query.dist[i] = finite ? (side < 0.0 ? -1.0 : 1.0) * std::sqrt(best.dist_sq) : NAN;
    interpolate(tree, tree.pos, best.face, best.bary, query.point + 3 * i, query.normal + 3 * i);
    interpolate(tree, query.next_pos, best.face, best.bary, query.next_point + 3 * i, query.next_normal + 3 * i);
}

// Halves the faces ``begin`` to ``end`` of the order along the longest side of their centres, into whole leaves as far as they go;
// returns the middle.
int32_t halve(Tree& tree, int32_t begin, int32_t end, const double* centre) {
    if (end - begin <= WIDE) return end;
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (int32_t i = begin; i < end; ++i)
        for (int k = 0; k < 3; ++k) {
            const double value = centre[3 * (int64_t)tree.order[i] + k];
            low[k] = std::min(low[k], value), high[k] = std::max(high[k], value);
        }
    int axis = 0;
    for (int k = 1; k < 3; ++k)
        if (high[k] - low[k] > high[axis] - low[axis]) axis = k;
    const int32_t middle = begin + WIDE * (((end - begin) / 2 + WIDE - 1) / WIDE);
    std::nth_element(tree.order + begin, tree.order + middle, tree.order + end, [&](int32_t a, int32_t b) {
        const double x = centre[3 * (int64_t)a + axis], y = centre[3 * (int64_t)b + axis];
        return x < y || (x == y && a < b);
    });
    return middle;
}

// The node, or -1 - leaf, of the faces ``begin`` to ``end`` of the order.
int32_t grow(Tree& tree, int32_t begin, int32_t end, const double* centre) {
    if (end - begin <= WIDE) {
        const int32_t leaf = (int32_t)tree.num_leaves++;
        tree.leaves[2 * leaf] = begin, tree.leaves[2 * leaf + 1] = end;
        return -1 - leaf;
    }
    const int32_t node = (int32_t)tree.num_nodes++;
    int32_t cut[WIDE + 1];
    cut[0] = begin, cut[WIDE] = end;
    for (int step = WIDE; step > 1; step /= 2)
        for (int i = 0; i < WIDE; i += step) cut[i + step / 2] = halve(tree, cut[i], cut[i + step], centre);
    for (int i = 0; i < WIDE; ++i) {
        const int32_t child = cut[i] < cut[i + 1] ? grow(tree, cut[i], cut[i + 1], centre) : node;
        tree.children[WIDE * (int64_t)node + i] = child;
    }
    return node;
}

}  // namespace

extern "C" {

// Nodes, leaves and the order of the faces in them, from centres (G, 3) of the faces.
void surface_build(Tree* tree, const double* centre) {
    tree->num_nodes = tree->num_leaves = 0;
    grow(*tree, 0, (int32_t)tree->num_faces, centre);
}

// Boxes around the faces where the vertices are now.
void surface_refit(Tree* tree) {
    for (int64_t leaf = 0; leaf < tree->num_leaves; ++leaf) {
        const int32_t begin = tree->leaves[2 * leaf], end = tree->leaves[2 * leaf + 1];
        for (int i = 0; i < WIDE; ++i) {
            const int64_t* face = tree->faces + 3 * (int64_t)tree->order[std::min(begin + i, end - 1)];
            for (int c = 0; c < 3; ++c)
                for (int k = 0; k < 3; ++k) tree->corners[WIDE * (9 * leaf + 3 * c + k) + i] = tree->pos[3 * face[c] + k];
        }
    }
    for (int64_t node = tree->num_nodes - 1; node >= 0; --node)  // children come after their node
        for (int i = 0; i < WIDE; ++i) {
            double* box = tree->boxes + 6 * WIDE * node + i;
            const int64_t child = tree->children[WIDE * node + i];
            for (int k = 0; k < 3; ++k) {
                double low = INFINITY, high = -INFINITY;
                if (child < 0) {
                    const double* table = tree->corners + 9 * WIDE * (-1 - child);
                    for (int c = 0; c < 3; ++c)
                        for (int j = 0; j < WIDE; ++j) {
                            const double value = table[WIDE * (3 * c + k) + j];
                            low = std::min(low, value), high = std::max(high, value);
                        }
                } else if (child != node) {
                    const double* inner = tree->boxes + 6 * WIDE * child;
                    for (int j = 0; j < WIDE; ++j) {
                        low = std::min(low, inner[WIDE * k + j]);
                        high = std::max(high, inner[WIDE * (3 + k) + j]);
                    }
                }
                box[WIDE * k] = low, box[WIDE * (3 + k)] = high;
            }
        }
}

void surface_search(const Tree* tree, const Query* query) {
    for (int64_t i = 0; i < query->count; ++i) search(*tree, *query, i);
}
}
