// Pairs of faces of a cloth that moves on straight ways, by a tree of boxes that move with it.
//
// A box has bounds where the way begins and where it ends; in between it is nowhere larger than the bounds between those. Two boxes
// that are apart along an axis, in the same order at both ends, are apart all the way: cloth that moves together is told apart as well
// as cloth that rests.
#pragma once
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "lanes.h"
#include "vector.h"

namespace {

typedef float Axes __attribute__((vector_size(16)));  // three, and a spare one
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

inline bool overlap(const MovingBox& a, const MovingBox& b) {
    return !any(((a.low[0] > b.high[0]) & (a.low[1] > b.high[1])) | ((b.low[0] > a.high[0]) & (b.low[1] > a.high[1])));
}

inline void join(MovingBox& box, const MovingBox& other) {
    for (int end = 0; end < 2; ++end) {
        box.low[end] = other.low[end] < box.low[end] ? other.low[end] : box.low[end];
        box.high[end] = other.high[end] > box.high[end] ? other.high[end] : box.high[end];
    }
}

// What is constant as long as the cloth; arrays of the caller.
struct LayerMesh {
    int64_t num_vertices, num_faces, num_edges;
    const int32_t *faces, *edges;                 // (F, 3), (E, 2)
    const int32_t *face_vertex, *face_edge;       // (F, 3) vertices and edges that a face answers for, then -1
    const int32_t *order, *piece;                 // (F) faces along the tree's leaves, (V) garment of a vertex
    const double *reach;                          // (V) m, distance at which a vertex is near others
    const double *vertex_area, *edge_area;        // (V), (E) m^2 at rest
    const double *edge_length_sq;                 // (E) m^2 at rest
};

// Features that the faces answer for, in the order of the faces, with their boxes.
struct OwnFeatures {
    std::vector<int32_t> starts, number;  // (F + 1), and what feature it is
    std::vector<MovingBox> box;

    void list(const int32_t* owned, const int32_t* order, int64_t num_faces) {
        starts.assign(1, 0), number.clear();
        for (int64_t i = 0; i < num_faces; ++i) {
            const int32_t* own = owned + 3 * (int64_t)order[i];
            for (int c = 0; c < 3 && own[c] >= 0; ++c) number.push_back(own[c]);
            starts.push_back((int32_t)number.size());
        }
        box.resize(number.size());
    }
};

// All of a face's neighbours in the tree are told by its place in the order.
struct LayerTree {
    std::vector<MovingBox> vertex, face, node;
    OwnFeatures vertices, edges;
    int64_t num_faces = 0;
    const int32_t* starts_of = nullptr;  // the order that features are listed in

    static constexpr int64_t LEAF = 4;

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
                box.low[end] = Axes{(float)(x - more), (float)(y - more), (float)(z - more), 0.0f};
                box.high[end] = Axes{(float)(x + more), (float)(y + more), (float)(z + more), 0.0f};
            }
        }
    }

    void build(const LayerMesh& mesh) {
        num_faces = mesh.num_faces;
        if (starts_of != mesh.order) {
            vertices.list(mesh.face_vertex, mesh.order, num_faces), edges.list(mesh.face_edge, mesh.order, num_faces);
            starts_of = mesh.order;
        }
        for (size_t i = 0; i < vertices.number.size(); ++i) vertices.box[i] = vertex[vertices.number[i]];
        for (size_t i = 0; i < edges.number.size(); ++i) {
            const int32_t* ends = mesh.edges + 2 * (int64_t)edges.number[i];
            edges.box[i] = vertex[ends[0]];
            join(edges.box[i], vertex[ends[1]]);
        }
        face.resize(num_faces);
        for (int64_t i = 0; i < num_faces; ++i) {
            const int32_t* corner = mesh.faces + 3 * (int64_t)mesh.order[i];
            face[i] = vertex[corner[0]];
            join(face[i], vertex[corner[1]]), join(face[i], vertex[corner[2]]);
        }
        int64_t size = 1;  // halves differ by a face at most, so that the levels above the last are full
        for (int64_t most = num_faces; most > LEAF; most = (most + 1) / 2) size = 2 * size + 1;
        node.resize(size);
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

    // visit(i, j) for pairs of faces whose boxes overlap.
    template <class Visit> void pairs(const Visit& visit) const {
        if (num_faces > 1) within(0, 0, num_faces, visit);
    }

    template <class Visit> void within(int64_t at, int64_t begin, int64_t end, const Visit& visit) const {
        if (end - begin <= LEAF) {
            for (int64_t i = begin; i < end; ++i)
                for (int64_t j = i + 1; j < end; ++j)
                    if (overlap(face[i], face[j])) visit(i, j);
            return;
        }
        const int64_t middle = (begin + end) / 2;
        within(2 * at + 1, begin, middle, visit);
        within(2 * at + 2, middle, end, visit);
        between(2 * at + 1, begin, middle, 2 * at + 2, middle, end, visit);
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

    template <class Visit>
    void between(int64_t a, int64_t a0, int64_t a1, int64_t b, int64_t b0, int64_t b1, const Visit& visit) const {
        if (!overlap(node[a], node[b])) return;
        const bool leaf_a = a1 - a0 <= LEAF, leaf_b = b1 - b0 <= LEAF;
        if (leaf_a && leaf_b) {
            for (int64_t i = a0; i < a1; ++i) {
                if (!overlap(face[i], node[b])) continue;
                for (int64_t j = b0; j < b1; ++j)
                    if (overlap(face[i], face[j])) visit(i, j);
            }
        } else if (leaf_b || (!leaf_a && a1 - a0 >= b1 - b0)) {
            const int64_t middle = (a0 + a1) / 2;
            between(2 * a + 1, a0, middle, b, b0, b1, visit);
            between(2 * a + 2, middle, a1, b, b0, b1, visit);
        } else {
            const int64_t middle = (b0 + b1) / 2;
            between(a, a0, a1, 2 * b + 1, b0, middle, visit);
            between(a, a0, a1, 2 * b + 2, middle, b1, visit);
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
    return inside ? dot(gap, gap) : best;
}

}  // namespace
