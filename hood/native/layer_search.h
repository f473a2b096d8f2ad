// Pairs of faces of a cloth that moves on straight ways, by a tree of boxes that move with it.
//
// A box has bounds where the way begins and where it ends; in between it is nowhere larger than the bounds between those. Two boxes
// that are apart along an axis, in the same order at both ends, are apart all the way: cloth that moves together is told apart as well
// as cloth that rests. Axes are x, y, z and a diagonal, for which a register has room: a quarter of the pairs is apart along it alone.
#pragma once
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <utility>
#include <vector>

#include "lanes.h"
#include "threads.h"
#include "vector.h"

namespace {

typedef float Axes __attribute__((vector_size(16)));
typedef decltype(Axes{} < Axes{}) AxesTest;

struct MovingBox {
    Axes low[2], high[2];
};

inline bool any(AxesTest test) {
#if defined(__SSE__)
    return __builtin_ia32_movmskps((Axes)test) != 0;
#else
    int64_t half[2];
    std::memcpy(half, &test, sizeof(half));
    return (half[0] | half[1]) != 0;
#endif
}

#if defined(__AVX__)
// Bits of the axes along which values are greater at both ends.
inline unsigned greater(const Axes* a, const Axes* b) {
    typedef float BothEnds __attribute__((vector_size(32)));
    const unsigned both = (unsigned)__builtin_ia32_movmskps256((BothEnds)(load<BothEnds>(a) > load<BothEnds>(b)));
    return both & both >> 4;
}

inline bool overlap(const MovingBox& a, const MovingBox& b) { return !(greater(a.low, b.high) | greater(b.low, a.high)); }
#else
inline bool overlap(const MovingBox& a, const MovingBox& b) {
    return !any(((a.low[0] > b.high[0]) & (a.low[1] > b.high[1])) | ((b.low[0] > a.high[0]) & (b.low[1] > a.high[1])));
}
#endif

inline void join(MovingBox& box, const MovingBox& other) {
    for (int end = 0; end < 2; ++end) {
        box.low[end] = other.low[end] < box.low[end] ? other.low[end] : box.low[end];
        box.high[end] = other.high[end] > box.high[end] ? other.high[end] : box.high[end];
    }
}

struct LayerTopology;

// What is constant as long as the cloth; arrays of the caller.
struct LayerMesh {
    int64_t num_vertices, num_faces, num_edges;
    const int32_t *faces, *edges;                 // (F, 3), (E, 2)
    const int32_t *face_vertex, *face_edge;       // (F, 3) vertices and edges that a face answers for, then -1
    const int32_t *order, *piece;                 // (F) faces along the tree's leaves, (V) garment of a vertex
    const double *reach;                          // (V) m, distance at which a vertex is near others
    const double *vertex_area, *edge_area;        // (V), (E) m^2 at rest
    const double *edge_length_sq;                 // (E) m^2 at rest
    const LayerTopology* topology;                // of these faces, see layers_topology
};

constexpr int64_t LEAF = 4;  // faces

// Halves differ by a face at most, so that the levels above the last are full.
inline int64_t num_nodes(int64_t num_faces) {
    int64_t size = 1;
    for (int64_t most = num_faces; most > LEAF; most = (most + 1) / 2) size = 2 * size + 1;
    return size;
}

// Whether the tree halves the first of two ranges of faces, one of which is no leaf, or the other one.
inline bool halves_first(int64_t count, int64_t other) { return other <= LEAF || (count > LEAF && count >= other); }

// A number of two faces, by their places i < j, in the order in which the tree visits pairs of faces.
inline uint64_t rank_of(int64_t num_faces, int64_t i, int64_t j) {
    uint64_t rank = 0;
    int at = 64;
    const auto append = [&](int bits, int64_t value) { rank |= (uint64_t)value << (at -= bits); };
    int64_t begin = 0, end = num_faces;
    while (end - begin > LEAF) {
        const int64_t middle = (begin + end) / 2;
        if (j < middle) {
            append(2, 0), end = middle;
        } else if (i >= middle) {
            append(2, 1), begin = middle;
        } else {
            append(2, 2);
            int64_t first[2] = {begin, middle}, second[2] = {middle, end};
            while (first[1] - first[0] > LEAF || second[1] - second[0] > LEAF) {
                const bool halved = halves_first(first[1] - first[0], second[1] - second[0]);
                int64_t* range = halved ? first : second;
                const int64_t half = (range[0] + range[1]) / 2, place = halved ? i : j;
                append(1, place >= half), range[place < half] = half;
            }
            append(2, i - first[0]), append(2, j - second[0]);
            return rank;
        }
    }
    append(2, i - begin), append(2, j - begin);
    return rank;
}

// Features that the faces answer for, in the order of the faces.
struct OwnFeatures {
    std::vector<int32_t> starts, number;  // (F + 1), and what feature it is

    void list(const int32_t* owned, const int32_t* order, int64_t num_faces) {
        starts.assign(1, 0), number.clear();
        for (int64_t i = 0; i < num_faces; ++i) {
            const int32_t* own = owned + 3 * (int64_t)order[i];
            for (int c = 0; c < 3 && own[c] >= 0; ++c) number.push_back(own[c]);
            starts.push_back((int32_t)number.size());
        }
    }
};

// A vertex and a face, or two edges, and the places of the faces that were looked at for them.
struct Candidate {
    int32_t first, second, faces[2];
};

// What the search knows of the faces whatever their positions are: boxes of most pairs of faces that overlap belong to faces with a
// common vertex, of which the features that may be near each other are always the same. All by places in the order.
struct LayerTopology {
    typedef std::pair<uint64_t, std::array<int32_t, 2>> Ranked;  // two faces and their rank
    // Two nodes, -1 without any, whose faces have no such vertex in common, after so many pairs of faces.
    struct Step {
        int32_t a, b, after;
    };

    OwnFeatures vertices, edges;
    std::vector<std::array<int32_t, 3>> corners;  // (F)
    // Of faces with a common vertex of few faces, as the tree visits them: pairs of features without one, by the places of their boxes.
    std::vector<Candidate> beside[2];
    std::vector<std::array<int32_t, 2>> boxes[2];
    int64_t num_beside = 0;  // pairs of such faces
    // Nodes that hold such faces always overlap: what the tree comes to by them, in its order. Pairs of faces without such a vertex
    // in leaves that hold others with one, and pairs of nodes.
    std::vector<std::array<int32_t, 2>> faces, span;  // and the faces of a node
    std::vector<Step> steps;

    static constexpr size_t MOST_AROUND = 64;  // pairs of faces at a vertex are as many as its square
    static constexpr int64_t SHARES = 32;      // two nodes of a step have at most this share of all faces, for threads

    explicit LayerTopology(const LayerMesh& mesh) : corners(mesh.num_faces) {
        vertices.list(mesh.face_vertex, mesh.order, mesh.num_faces), edges.list(mesh.face_edge, mesh.order, mesh.num_faces);
        std::vector<std::vector<int32_t>> around(mesh.num_vertices);
        for (int64_t i = 0; i < mesh.num_faces; ++i)
            for (int c = 0; c < 3; ++c) around[corners[i][c] = mesh.faces[3 * (int64_t)mesh.order[i] + c]].push_back((int32_t)i);
        std::vector<Ranked> both;
        for (int64_t i = 0; i < mesh.num_faces; ++i)
            for (int32_t v : corners[i])
                for (size_t k = 0; around[v].size() <= MOST_AROUND && k < around[v].size(); ++k)
                    if (const int32_t j = around[v][k]; i < j) both.push_back({rank_of(mesh.num_faces, i, j), {(int32_t)i, j}});
        std::sort(both.begin(), both.end());
        both.erase(std::unique(both.begin(), both.end()), both.end());
        num_beside = (int64_t)both.size();
        for (const auto& [rank, faces] : both) list(mesh, faces[0], faces[1]);
        span.resize(num_nodes(mesh.num_faces));
        if (mesh.num_faces) spread(0, 0, (int32_t)mesh.num_faces);
        const Ranked* next = both.data();
        if (mesh.num_faces) step_within(0, next, next + both.size());
        steps.push_back({-1, -1, (int32_t)faces.size()});
    }

    void spread(int32_t at, int32_t begin, int32_t end) {
        span[at] = {begin, end};
        if (end - begin <= LEAF) return;
        spread(2 * at + 1, begin, (begin + end) / 2), spread(2 * at + 2, (begin + end) / 2, end);
    }

    int64_t size(int32_t at) const { return span[at][1] - span[at][0]; }

    // The steps within a node, or between two; ``next`` are faces with a common vertex that are still to come.
    void step_within(int32_t at, const Ranked*& next, const Ranked* last) {
        if (size(at) <= LEAF) return step_leaves(at, at, next, last);
        step_within(2 * at + 1, next, last), step_within(2 * at + 2, next, last);
        step_between(2 * at + 1, 2 * at + 2, next, last);
    }

    void step_between(int32_t a, int32_t b, const Ranked*& next, const Ranked* last) {
        const auto in = [&](int32_t face, int32_t at) { return face >= span[at][0] && face < span[at][1]; };
        const bool beside = next < last && in(next->second[0], a) && in(next->second[1], b), leaves = size(a) <= LEAF && size(b) <= LEAF;
        if (!beside && (leaves || SHARES * (size(a) + size(b)) <= size(0))) return steps.push_back({a, b, (int32_t)faces.size()});
        if (leaves) return step_leaves(a, b, next, last);
        if (halves_first(size(a), size(b))) return step_between(2 * a + 1, b, next, last), step_between(2 * a + 2, b, next, last);
        step_between(a, 2 * b + 1, next, last), step_between(a, 2 * b + 2, next, last);
    }

    void step_leaves(int32_t a, int32_t b, const Ranked*& next, const Ranked* last) {
        for (int32_t i = span[a][0]; i < span[a][1]; ++i)
            for (int32_t j = a == b ? i + 1 : span[b][0]; j < span[b][1]; ++j)
                if (const std::array<int32_t, 2> pair = {i, j}; next < last && next->second == pair) ++next;
                else faces.push_back(pair);
    }

    bool holds(int64_t face, int32_t v) const { return (v == corners[face][0]) | (v == corners[face][1]) | (v == corners[face][2]); }

    static bool meet(const LayerMesh& mesh, int32_t a, int32_t b) {
        const int32_t *one = mesh.edges + 2 * (int64_t)a, *two = mesh.edges + 2 * (int64_t)b;
        return (one[0] == two[0]) | (one[0] == two[1]) | (one[1] == two[0]) | (one[1] == two[1]);
    }

    void list(const LayerMesh& mesh, int32_t i, int32_t j) {
        for (int32_t face : {i, j}) {
            const int32_t other = face == i ? j : i;
            for (int32_t p = vertices.starts[face]; p < vertices.starts[face + 1]; ++p)
                if (!holds(other, vertices.number[p])) {
                    beside[0].push_back({vertices.number[p], mesh.order[other], {i, j}});
                    boxes[0].push_back({p, other});
                }
        }
        for (int32_t p = edges.starts[i]; p < edges.starts[i + 1]; ++p)
            for (int32_t q = edges.starts[j]; q < edges.starts[j + 1]; ++q) {
                const int32_t a = edges.number[p], b = edges.number[q];
                if (meet(mesh, a, b)) continue;
                beside[1].push_back({std::min(a, b), std::max(a, b), {i, j}});
                boxes[1].push_back({p, q});
            }
    }
};

// All of a face's neighbours in the tree are told by its place in the order.
struct LayerTree {
    std::vector<MovingBox> vertex, face, node;
    std::vector<MovingBox> own_vertex, own_edge;  // of the topology's features
    int64_t num_faces = 0;

    // Boxes of vertices on their ways, so much wider on all sides; ``wide`` by vertex, and what the rounding of positions asks for.
    void enclose(const double* from, const double* to, const std::vector<double>& wide) {
        const int64_t count = (int64_t)wide.size();
        vertex.resize(count);
        double centre[3], size = 0.0;
        for (int k = 0; k < 3; ++k) centre[k] = count ? from[k] : 0.0;
        for (int64_t i = 0; i < 3 * count; ++i)
            size = std::max(size, std::max(std::fabs(from[i] - centre[i % 3]), std::fabs(to[i] - centre[i % 3])));
        const double rounding = 1e-6 * size;
        for (int64_t v = 0; v < count; ++v) {
            MovingBox& box = vertex[v];
            const double more = wide[v] + rounding;
            for (int end = 0; end < 2; ++end) {
                const double* at = (end ? to : from) + 3 * v;
                const double x = at[0] - centre[0], y = at[1] - centre[1], z = at[2] - centre[2];
                const double diagonal = 0.5773502691896258 * (x - y + z);
                box.low[end] = Axes{(float)(x - more), (float)(y - more), (float)(z - more), (float)(diagonal - more)};
                box.high[end] = Axes{(float)(x + more), (float)(y + more), (float)(z + more), (float)(diagonal + more)};
            }
        }
    }

    void build(const LayerMesh& mesh, int64_t parts) {
        num_faces = mesh.num_faces;
        const std::vector<int32_t>&vertices = mesh.topology->vertices.number, &edges = mesh.topology->edges.number;
        own_vertex.resize(vertices.size()), own_edge.resize(edges.size()), face.resize(num_faces);
        for_parts(parts, [&](int64_t part) {
            const Range mine[3] = {range_of(vertices.size(), part, parts), range_of(edges.size(), part, parts), range_of(num_faces, part, parts)};
            for (int64_t i = mine[0].begin; i < mine[0].end; ++i) own_vertex[i] = vertex[vertices[i]];
            for (int64_t i = mine[1].begin; i < mine[1].end; ++i) {
                const int32_t* ends = mesh.edges + 2 * (int64_t)edges[i];
                own_edge[i] = vertex[ends[0]];
                join(own_edge[i], vertex[ends[1]]);
            }
            for (int64_t i = mine[2].begin; i < mine[2].end; ++i) {
                const std::array<int32_t, 3>& corner = mesh.topology->corners[i];
                face[i] = vertex[corner[0]];
                join(face[i], vertex[corner[1]]), join(face[i], vertex[corner[2]]);
            }
        });
        node.resize(num_nodes(num_faces));
        if (num_faces) refit(0, 0, num_faces);
    }

    void refit(int64_t at, int64_t begin, int64_t end) {
        if (end - begin <= LEAF) {
            MovingBox box = face[begin];
            for (int64_t i = begin + 1; i < end; ++i) join(box, face[i]);
            node[at] = box;
            return;
        }
        const int64_t middle = (begin + end) / 2;
        refit(2 * at + 1, begin, middle);
        refit(2 * at + 2, middle, end);
        node[at] = node[2 * at + 1];
        join(node[at], node[2 * at + 2]);
    }

    // visit(i, j) for pairs of faces whose boxes overlap, without a common vertex of few faces: of some steps, in their order.
    template <class Visit> void pairs(const LayerTopology& topology, Range steps, const Visit& visit) const {
        int32_t k = steps.begin ? topology.steps[steps.begin - 1].after : 0;
        for (int64_t i = steps.begin; i < steps.end; ++i) {
            const LayerTopology::Step step = topology.steps[i];
            for (; k < step.after; ++k)
                if (const auto [one, other] = topology.faces[k]; overlap(face[one], face[other])) visit(one, other);
            if (step.a < 0 || !overlap(node[step.a], node[step.b])) continue;
            const std::array<int32_t, 2>&a = topology.span[step.a], &b = topology.span[step.b];
            between(step.a, a[0], a[1], step.b, b[0], b[1], visit);
        }
    }

    // visit(j) for faces whose boxes overlap a box.
    template <class Visit> void around(const MovingBox& box, int64_t at, int64_t begin, int64_t end, const Visit& visit) const {
        if (!overlap(box, node[at])) return;
        if (end - begin <= LEAF) {
            for (int64_t j = begin; j < end; ++j)
                if (overlap(box, face[j])) visit(j);
            return;
        }
        const int64_t middle = (begin + end) / 2;
        around(box, 2 * at + 1, begin, middle, visit);
        around(box, 2 * at + 2, middle, end, visit);
    }

    // The same between two nodes whose boxes overlap.
    template <class Visit>
    void between(int64_t a, int64_t a0, int64_t a1, int64_t b, int64_t b0, int64_t b1, const Visit& visit) const {
        const bool leaf_a = a1 - a0 <= LEAF, leaf_b = b1 - b0 <= LEAF;
        const auto go_on = [&](int64_t one, int64_t begin, int64_t end, int64_t other, int64_t first, int64_t last) {
            if (overlap(node[one], node[other])) between(one, begin, end, other, first, last, visit);
        };
        if (leaf_a && leaf_b) {
            for (int64_t i = a0; i < a1; ++i) {
                if (!overlap(face[i], node[b])) continue;
                for (int64_t j = b0; j < b1; ++j)
                    if (overlap(face[i], face[j])) visit(i, j);
            }
        } else if (halves_first(a1 - a0, b1 - b0)) {
            const int64_t middle = (a0 + a1) / 2;
            go_on(2 * a + 1, a0, middle, b, b0, b1), go_on(2 * a + 2, middle, a1, b, b0, b1);
        } else {
            const int64_t middle = (b0 + b1) / 2;
            go_on(a, a0, a1, 2 * b + 1, b0, middle), go_on(a, a0, a1, 2 * b + 2, middle, b1);
        }
    }
};

// ---- distances of pairs, one a lane --- -------------------------------------------------------------------------------------

struct Lanes3 {
    VN x, y, z;
};
inline Lanes3 operator-(const Lanes3& a, const Lanes3& b) { return {a.x - b.x, a.y - b.y, a.z - b.z}; }
inline VN dot(const Lanes3& a, const Lanes3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
inline Lanes3 cross(const Lanes3& a, const Lanes3& b) { return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x}; }
inline VN less(VN a, VN b) { return a < b ? a : b; }
inline VN more(VN a, VN b) { return a > b ? a : b; }

// Square of the distance of the end of ``from`` to the segment from 0 along ``along``.
inline VN segment_sq(const Lanes3& from, const Lanes3& along) {
    const VN size = dot(along, along), zero = every(0.0), one = every(1.0);
    const VN share = more(zero, less(one, dot(from, along) / (size > zero ? size : one)));
    const Lanes3 gap = {from.x - share * along.x, from.y - share * along.y, from.z - share * along.z};
    return dot(gap, gap);
}

// Squares of the distances of points to triangles, as point_triangle finds them.
inline VN point_triangle_sq(const Lanes3* x) {
    const VN zero = every(0.0), one = every(1.0);
    const Lanes3 first = x[2] - x[1], second = x[3] - x[1], third = x[3] - x[2], offset = x[0] - x[1];
    const VN best = less(segment_sq(offset, first), less(segment_sq(offset, second), segment_sq(x[0] - x[2], third)));
    const Lanes3 normal = cross(first, second);
    const VN area_sq = dot(normal, normal);
    const IN sound = area_sq > 1e-24 * dot(first, first) * dot(second, second);
    const VN scale = 1.0 / (sound ? area_sq : one), height = dot(offset, normal);
    const VN y = dot(cross(offset, second), normal) * scale, z = dot(cross(first, offset), normal) * scale;
    const IN inside = sound & (y >= zero) & (z >= zero) & (y + z <= one);
    return inside ? height * height * scale : best;
}

// The same of two segments.
inline VN segment_segment_sq(const Lanes3* x) {
    const VN zero = every(0.0), one = every(1.0);
    const Lanes3 u = x[1] - x[0], v = x[3] - x[2], w = x[0] - x[2];
    const VN best = less(less(segment_sq(w, v), segment_sq(x[1] - x[2], v)), less(segment_sq(x[2] - x[0], u), segment_sq(x[3] - x[0], u)));
    const VN uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w), det = uu * vv - uv * uv;
    const IN sound = det > 1e-24 * uu * vv;
    const VN scale = 1.0 / (sound ? det : one), s = (uv * vw - vv * uw) * scale, t = (uu * vw - uv * uw) * scale;
    const IN inside = sound & (s >= zero) & (s <= one) & (t >= zero) & (t <= one);
    const Lanes3 gap = {w.x + s * u.x - t * v.x, w.y + s * u.y - t * v.y, w.z + s * u.z - t * v.z};
    return inside ? less(dot(gap, gap), best) : best;
}

}  // namespace
