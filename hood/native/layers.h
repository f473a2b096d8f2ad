// Cloth near cloth: a list of pairs of features that may come near each other, a barrier on their distance, and how far vertices
// may move along straight lines before two features meet. See hood/mesh/layers.py and hood/losses/layers.py.
//
// A pair is a vertex and a face, or two edges, without a common vertex. Every vertex has a box; all pairs that can be within their
// reach while every vertex is in its box are in the list, so that sums over it are sums over all pairs, and no two features can
// meet that are not in it. Where a vertex leaves its box the box grows and the list is made anew. The numbering is the cloth's own.
#pragma once
#include <algorithm>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <limits>
#include <vector>

#include "vector.h"

namespace {

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

struct LayerPair {
    int32_t corner[4];  // a vertex and a face, or two edges
    int32_t edges;      // 1 for two edges
    double reach, area, parallel;  // m; m^2; m^4: square of the edges' cross product below which the barrier fades
};

struct LayerBox {
    double low[3], high[3];
};

// A pair within its reach.
struct LayerContact {
    int32_t pair;
    double weight[4], dist;  // the gap is the sum of weight times corner
    double gap[3];
};

inline double layer_clamp(double v) { return v < 0.0 ? 0.0 : v > 1.0 ? 1.0 : v; }

inline double point_segment(Vec p, Vec a, Vec b, double* share) {
    const Vec along = b - a, from = p - a;
    const double size = dot(along, along);
    *share = size > 0.0 ? layer_clamp(dot(from, along) / size) : 0.0;
    const Vec gap = from - *share * along;
    return dot(gap, gap);
}

// Square of the distance of a point to a triangle, and weights of all four such that the gap is their sum.
inline double point_triangle(Vec p, Vec a, Vec b, Vec c, double* weight) {
    const Vec corner[3] = {a, b, c}, first = b - a, second = c - a, offset = p - a, normal = cross(first, second);
    const double area_sq = dot(normal, normal);
    weight[0] = 1.0;
    if (area_sq > 1e-24 * dot(first, first) * dot(second, second)) {
        const double y = dot(cross(offset, second), normal) / area_sq, z = dot(cross(first, offset), normal) / area_sq, x = 1.0 - y - z;
        if (x >= 0.0 && y >= 0.0 && z >= 0.0) {
            const double height = dot(offset, normal);
            weight[1] = -x, weight[2] = -y, weight[3] = -z;
            return height * height / area_sq;
        }
    }
    double best = std::numeric_limits<double>::infinity();
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        double share;
        const double square = point_segment(p, corner[i], corner[j], &share);
        if (!(square < best)) continue;
        best = square;
        weight[1 + i] = share - 1.0, weight[1 + j] = -share, weight[1 + (i + 2) % 3] = 0.0;
    }
    return best;
}

// The same for two segments.
inline double segment_segment(Vec a, Vec b, Vec c, Vec d, double* weight) {
    const Vec u = b - a, v = d - c, w = a - c;
    const double uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), uw = dot(u, w), vw = dot(v, w), det = uu * vv - uv * uv;
    if (det > 1e-24 * uu * vv) {
        const double s = (uv * vw - vv * uw) / det, t = (uu * vw - uv * uw) / det;
        if (s >= 0.0 && s <= 1.0 && t >= 0.0 && t <= 1.0) {
            const Vec gap = w + s * u - t * v;
            weight[0] = 1.0 - s, weight[1] = s, weight[2] = t - 1.0, weight[3] = -t;
            return dot(gap, gap);
        }
    }
    double best = std::numeric_limits<double>::infinity(), share;
    const Vec end[4] = {a, b, c, d};
    for (int i = 0; i < 4; ++i) {
        const double square = i < 2 ? point_segment(end[i], c, d, &share) : point_segment(end[i], a, b, &share);
        if (!(square < best)) continue;
        best = square;
        const double sign = i < 2 ? 1.0 : -1.0;
        for (int k = 0; k < 4; ++k) weight[k] = 0.0;
        weight[i] = sign;
        const int other = i < 2 ? 2 : 0;
        weight[other] = -sign * (1.0 - share), weight[other + 1] = -sign * share;
    }
    return best;
}

inline double pair_distance_sq(int32_t edges, const Vec* x, double* weight) {
    return edges ? segment_segment(x[0], x[1], x[2], x[3], weight) : point_triangle(x[0], x[1], x[2], x[3], weight);
}

// The barrier -(1 - s)^2 ln s of the distance in units of the reach, and its first two derivatives.
inline double barrier(double s) { return -(1.0 - s) * (1.0 - s) * std::log(s); }
inline double barrier_slope(double s) { return 2.0 * (1.0 - s) * std::log(s) - (1.0 - s) * (1.0 - s) / s; }
inline double barrier_curvature(double s) {
    const double rest = (1.0 - s) / s;
    return -2.0 * std::log(s) + 4.0 * rest + rest * rest;
}

// Share of the barrier of two edges, which fades where they are parallel: their distance has a kink there. Its slope by the
// square of their cross product.
inline double fading(double square, double parallel, double* slope) {
    const double ratio = square / parallel;
    if (ratio >= 1.0) {
        *slope = 0.0;
        return 1.0;
    }
    *slope = 2.0 * (1.0 - ratio) / parallel;
    return ratio * (2.0 - ratio);
}

// Along straight lines from x by p, the share of the way that is safe: 1, or where at least ``left`` of the first distance is kept.
// By additive conservative advancement: no two points of the features come nearer than by the largest relative motion.
inline double safe_share(int32_t edges, const Vec* x0, const Vec* p0, double left) {
    Vec x[4], p[4];
    const Vec mean = 0.25 * (p0[0] + p0[1] + p0[2] + p0[3]);
    double size[4];
    for (int i = 0; i < 4; ++i) x[i] = x0[i], p[i] = p0[i] - mean, size[i] = dot(p[i], p[i]);
    const double way = edges ? std::sqrt(std::max(size[0], size[1])) + std::sqrt(std::max(size[2], size[3]))
                             : std::sqrt(size[0]) + std::sqrt(std::max(size[1], std::max(size[2], size[3])));
    if (!(way > 0.0)) return 1.0;
    double weight[4], dist = std::sqrt(pair_distance_sq(edges, x, weight));
    const double kept = left * dist;
    if (dist - kept >= way) return 1.0;
    double time = 0.0;
    while (dist - kept > 0.01 * dist) {
        const double step = 0.9 * (dist - kept) / way;
        if (time + step >= 1.0) return 1.0;
        time += step;
        for (int i = 0; i < 4; ++i) x[i] = x0[i] + time * p[i];
        dist = std::sqrt(pair_distance_sq(edges, x, weight));
    }
    return time;
}

// Adds the time it lives.
struct LayerTimer {
    double& seconds;
    std::chrono::steady_clock::time_point began = std::chrono::steady_clock::now();
    ~LayerTimer() { seconds += std::chrono::duration<double>(std::chrono::steady_clock::now() - began).count(); }
};

struct Layers {
    LayerMesh mesh;
    double pressure = 0.0;  // Pa
    bool between = false;   // pairs of two garments alone
    std::vector<uint8_t> fixed;
    std::vector<double> low, high, margin;  // (3 V), (3 V), (V) boxes and how far beyond a vertex they go
    std::vector<uint64_t> released;         // sorted keys of pairs that are left out
    std::vector<LayerPair> pairs;
    std::vector<uint64_t> keys;
    std::vector<LayerContact> contacts;     // of the last model
    std::vector<LayerBox> tree, vertex_box, edge_box, face_box;
    std::vector<double> start;  // (3 V) where the step begins
    bool begun = false, swept = false;  // the list is one of a way
    int64_t searches = 0, crossed = 0;  // pairs of faces that are crossed where it begins
    double seconds = 0.0;  // of everything but what the solver does with the rows
    bool overflowed = false;  // cloth so crumpled, or torn, that nearly everything is near everything: no list
    // For the solver.
    std::vector<double> here, there, gradient, own;  // (3 V) twice, (3 V), (6 V)
    std::vector<int32_t> row, rows;                  // (V) number of a vertex in the solver, (N, 4)
    std::vector<double> normals;                     // (N, 12)
    std::vector<float> normals_single;

    uint64_t key(int32_t edges, int64_t first, int64_t second) const {
        return edges ? ((uint64_t)1 << 63) | ((uint64_t)first * mesh.num_edges + second) : (uint64_t)first * mesh.num_faces + second;
    }

    // ---- boxes and the list --------------------------------------------------------------------------------------------

    void box_of(int64_t v, LayerBox& box) const {
        const double wide = 0.5 * mesh.reach[v];
        for (int k = 0; k < 3; ++k) box.low[k] = low[3 * v + k] - wide, box.high[k] = high[3 * v + k] + wide;
    }

    static bool overlap(const LayerBox& a, const LayerBox& b) {
        bool apart = false;
        for (int k = 0; k < 3; ++k) apart |= a.low[k] > b.high[k] || a.high[k] < b.low[k];
        return !apart;
    }

    static constexpr int64_t LEAF = 4;
    static constexpr int64_t MOST_PAIRS = 4000000;
    static constexpr int64_t MOST_LOOKS = 300;  // at pairs of faces, for each face: beyond it the cloth is torn

    template <class Box> void refit(int64_t node, int64_t begin, int64_t end, const Box& box_at) {
        if ((int64_t)tree.size() <= node) tree.resize(node + 1);
        if (end - begin <= LEAF) {
            LayerBox box = box_at(begin);
            for (int64_t i = begin + 1; i < end; ++i) join(box, box_at(i));
            tree[node] = box;
            return;
        }
        const int64_t middle = (begin + end) / 2;
        refit(2 * node + 1, begin, middle, box_at);
        refit(2 * node + 2, middle, end, box_at);
        LayerBox box = tree[2 * node + 1];
        join(box, tree[2 * node + 2]);
        tree[node] = box;
    }

    static void join(LayerBox& box, const LayerBox& other) {
        for (int k = 0; k < 3; ++k) box.low[k] = std::min(box.low[k], other.low[k]), box.high[k] = std::max(box.high[k], other.high[k]);
    }

    // Pairs of places in the order whose boxes overlap; a place and itself is none.
    template <class Visit>
    void overlapping(int64_t a, int64_t a0, int64_t a1, int64_t b, int64_t b0, int64_t b1, const std::vector<LayerBox>& box, const Visit& visit) const {
        if (a != b && !overlap(tree[a], tree[b])) return;
        const bool leaf_a = a1 - a0 <= LEAF, leaf_b = b1 - b0 <= LEAF;
        if (leaf_a && leaf_b) {
            for (int64_t i = a0; i < a1; ++i)
                for (int64_t j = a == b ? i + 1 : b0; j < b1; ++j)
                    if (overlap(box[i], box[j])) visit(i, j);
            return;
        }
        const int64_t am = (a0 + a1) / 2, bm = (b0 + b1) / 2;
        if (a == b) {
            overlapping(2 * a + 1, a0, am, 2 * a + 1, a0, am, box, visit);
            overlapping(2 * a + 2, am, a1, 2 * a + 2, am, a1, box, visit);
            overlapping(2 * a + 1, a0, am, 2 * a + 2, am, a1, box, visit);
        } else if (leaf_b || (!leaf_a && a1 - a0 >= b1 - b0)) {
            overlapping(2 * a + 1, a0, am, b, b0, b1, box, visit);
            overlapping(2 * a + 2, am, a1, b, b0, b1, box, visit);
        } else {
            overlapping(a, a0, a1, 2 * b + 1, b0, bm, box, visit);
            overlapping(a, a0, a1, 2 * b + 2, bm, b1, box, visit);
        }
    }

    void box_features() {
        vertex_box.resize(mesh.num_vertices), edge_box.resize(mesh.num_edges), face_box.resize(mesh.num_faces);
        for (int64_t v = 0; v < mesh.num_vertices; ++v) box_of(v, vertex_box[v]);
        for (int64_t e = 0; e < mesh.num_edges; ++e) edge_box[e] = joined(mesh.edges + 2 * e, 2);
        for (int64_t f = 0; f < mesh.num_faces; ++f) face_box[f] = joined(mesh.faces + 3 * f, 3);
    }

    LayerBox joined(const int32_t* corners, int count) const {
        LayerBox box = vertex_box[corners[0]];
        for (int c = 1; c < count; ++c) join(box, vertex_box[corners[c]]);
        return box;
    }

    template <class Visit> void face_pairs(const Visit& visit) {
        if (mesh.num_faces < 2) return;
        box_features();
        std::vector<LayerBox> box(mesh.num_faces);
        for (int64_t i = 0; i < mesh.num_faces; ++i) box[i] = face_box[mesh.order[i]];
        refit(0, 0, mesh.num_faces, [&](int64_t i) { return box[i]; });
        overlapping(0, 0, mesh.num_faces, 0, 0, mesh.num_faces, box,
                    [&](int64_t i, int64_t j) { visit(mesh.order[i], mesh.order[j]); });
    }

    bool is_released(uint64_t k) const { return !released.empty() && std::binary_search(released.begin(), released.end(), k); }

    void add(int32_t edges, const LayerBox& one, const LayerBox& other, const int32_t* corner, int64_t first, int64_t second, double area, double parallel) {
        if (!overlap(one, other)) return;
        for (int i = 0; i < (edges ? 2 : 1); ++i)
            for (int j = edges ? 2 : 1; j < 4; ++j)
                if (corner[i] == corner[j]) return;
        if (fixed[corner[0]] && fixed[corner[1]] && fixed[corner[2]] && fixed[corner[3]]) return;
        if (between && mesh.piece[corner[0]] == mesh.piece[corner[3]]) return;
        LayerPair pair;
        std::copy(corner, corner + 4, pair.corner);
        pair.edges = edges, pair.area = area, pair.parallel = parallel;
        pair.reach = std::min(std::min(mesh.reach[corner[0]], mesh.reach[corner[1]]), std::min(mesh.reach[corner[2]], mesh.reach[corner[3]]));
        if (out_of_reach(pair)) return;
        const uint64_t k = key(edges, first, second);
        if (is_released(k)) return;
        pairs.push_back(pair);
        keys.push_back(k);
    }

    // Whether features are apart wherever in their boxes the corners are: by their distance at the middle, less the way from there.
    bool out_of_reach(const LayerPair& pair) const {
        const int split = pair.edges ? 2 : 1;
        double way[2] = {0.0, 0.0}, weight[4];
        Vec x[4];
        for (int c = 0; c < 4; ++c) {
            const Vec l = at(low.data(), pair.corner[c]), h = at(high.data(), pair.corner[c]), half = 0.5 * (h - l);
            x[c] = 0.5 * (l + h);
            way[c >= split] = std::max(way[c >= split], dot(half, half));
        }
        const double far = pair.reach + std::sqrt(way[0]) + std::sqrt(way[1]);
        return pair_distance_sq(pair.edges, x, weight) > far * far * (1.0 + 1e-9);
    }

    void add_vertex(int32_t v, int64_t f) {
        const int32_t* face = mesh.faces + 3 * f;
        const int32_t corner[4] = {v, face[0], face[1], face[2]};
        add(0, vertex_box[v], face_box[f], corner, v, f, mesh.vertex_area[v], 0.0);
    }

    void add_edges(int64_t a, int64_t b) {
        if (a > b) std::swap(a, b);
        const int32_t corner[4] = {mesh.edges[2 * a], mesh.edges[2 * a + 1], mesh.edges[2 * b], mesh.edges[2 * b + 1]};
        add(1, edge_box[a], edge_box[b], corner, a, b, 0.5 * (mesh.edge_area[a] + mesh.edge_area[b]), 1e-3 * mesh.edge_length_sq[a] * mesh.edge_length_sq[b]);
    }

    void search(const double* crossing_at = nullptr) {
        pairs.clear(), keys.clear(), contacts.clear();
        ++searches;
        overflowed = overflowed || !finite();
        if (overflowed) return;
        int64_t looked_at = 0;
        const auto too_many = [&] { return looked_at > MOST_LOOKS * mesh.num_faces || (int64_t)pairs.size() > MOST_PAIRS; };
        face_pairs([&](int64_t f, int64_t g) {
            if (too_many()) return;
            ++looked_at;
            if (crossing_at && crossed_faces(f, g, crossing_at)) ++crossed, release_faces(f, g);
            const int32_t *of_f = mesh.face_edge + 3 * f, *of_g = mesh.face_edge + 3 * g;
            for (int c = 0; c < 3 && mesh.face_vertex[3 * f + c] >= 0; ++c) add_vertex(mesh.face_vertex[3 * f + c], g);
            for (int c = 0; c < 3 && mesh.face_vertex[3 * g + c] >= 0; ++c) add_vertex(mesh.face_vertex[3 * g + c], f);
            for (int c = 0; c < 3 && of_f[c] >= 0; ++c)
                for (int d = 0; d < 3 && of_g[d] >= 0; ++d) add_edges(of_f[c], of_g[d]);
        });
        overflowed = too_many();
        if (overflowed) pairs.clear(), keys.clear();
        if (crossed) forget_released();
    }

    bool finite() const {
        double sum = 0.0;
        for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) sum += 0.0 * low[i] + 0.0 * high[i];
        return sum == 0.0;
    }

    // Takes pairs out of the list that are to be left out.
    void forget_released() {
        std::sort(released.begin(), released.end());
        size_t kept = 0;
        for (size_t i = 0; i < pairs.size(); ++i)
            if (!is_released(keys[i])) pairs[kept] = pairs[i], keys[kept++] = keys[i];
        pairs.resize(kept), keys.resize(kept);
    }

    // The first list of a step from positions (V, 3): what is crossed there is left out.
    void begin() { begin(start.data()); }
    void begin(const double* target) {
        if (begun) return;
        begun = true;
        low.resize(3 * mesh.num_vertices), high.resize(3 * mesh.num_vertices);
        for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) {
            low[i] = std::min(start[i], target[i]) - margin[i / 3];
            high[i] = std::max(start[i], target[i]) + margin[i / 3];
        }
        search(start.data());
    }

    // Boxes around positions (V, 3) alone.
    void enclose(const double* pos) {
        for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) low[i] = pos[i] - margin[i / 3], high[i] = pos[i] + margin[i / 3];
        swept = false;
        search();
    }

    // The list of a way is long where cloth moves far: it is made anew for the place that it led to.
    void settle(const double* pos) {
        if (swept && (int64_t)pairs.size() > mesh.num_vertices) enclose(pos);
    }

    bool inside(const double* pos, int64_t v) const {
        bool out = false;
        for (int k = 0; k < 3; ++k) out |= !(pos[3 * v + k] >= low[3 * v + k] && pos[3 * v + k] <= high[3 * v + k]);
        return !out;
    }

    // Makes sure that the list holds at positions (V, 3), and on straight ways between two. Where a vertex has left its box all
    // boxes are made anew around them.
    void cover(const double* pos) { cover(pos, pos); }
    void cover(const double* pos, const double* there) {
        begin(there);
        if (overflowed) return;
        bool left = false;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) {
            left = left || !inside(pos, v) || !inside(there, v);
        }
        if (!left) return;
        swept = true;
        for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) {
            low[i] = std::min(pos[i], there[i]) - margin[i / 3];
            high[i] = std::max(pos[i], there[i]) + margin[i / 3];
        }
        search();
    }

    // ---- crossings -----------------------------------------------------------------------------------------------------

    static bool pierces(Vec a, Vec b, const Vec* t) {
        const Vec normal = cross(t[1] - t[0], t[2] - t[0]);
        const double ha = dot(a - t[0], normal), hb = dot(b - t[0], normal);
        if ((ha > 0.0) == (hb > 0.0)) return false;
        const Vec along = b - a;
        const double x = dot(along, cross(t[0] - a, t[1] - a)), y = dot(along, cross(t[1] - a, t[2] - a)), z = dot(along, cross(t[2] - a, t[0] - a));
        return (x >= 0.0 && y >= 0.0 && z >= 0.0) || (x <= 0.0 && y <= 0.0 && z <= 0.0);
    }

    // Whether two faces without a common vertex pass through each other at positions (V, 3).
    bool crossed_faces(int64_t f, int64_t g, const double* pos) const {
        const int32_t *a = mesh.faces + 3 * f, *b = mesh.faces + 3 * g;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j)
                if (a[i] == b[j]) return false;
        if (between && mesh.piece[a[0]] == mesh.piece[b[0]]) return false;
        Vec x[3], y[3];
        for (int c = 0; c < 3; ++c) x[c] = at(pos, a[c]), y[c] = at(pos, b[c]);
        bool crossed = false;
        for (int c = 0; c < 3; ++c) crossed |= pierces(x[c], x[(c + 1) % 3], y) || pierces(y[c], y[(c + 1) % 3], x);
        return crossed;
    }

    int64_t edge_number(int32_t a, int32_t b) const {
        if (a > b) std::swap(a, b);
        int64_t begin = 0, end = mesh.num_edges;  // edges are sorted
        while (begin < end) {
            const int64_t middle = (begin + end) / 2;
            const int32_t* e = mesh.edges + 2 * middle;
            if (e[0] < a || (e[0] == a && e[1] < b)) begin = middle + 1;
            else end = middle;
        }
        return begin;
    }

    void release_faces(int64_t f, int64_t g) {
        const int32_t *a = mesh.faces + 3 * f, *b = mesh.faces + 3 * g;
        for (int c = 0; c < 3; ++c) {
            released.push_back(key(0, a[c], g));
            released.push_back(key(0, b[c], f));
            for (int d = 0; d < 3; ++d) {
                const int64_t one = edge_number(a[c], a[(c + 1) % 3]), two = edge_number(b[d], b[(d + 1) % 3]);
                released.push_back(key(1, std::min(one, two), std::max(one, two)));
            }
        }
    }

    // ---- the way -------------------------------------------------------------------------------------------------------

    // Share of the straight ways between positions (V, 3) that no two features meet on, and the pairs that would.
    double limit(const double* from, const double* to, double left, std::vector<int32_t>* meeting = nullptr, std::vector<double>* shares = nullptr) {
        cover(from, to);
        double least = 1.0;
        for (size_t i = 0; i < pairs.size(); ++i) {
            const LayerPair& pair = pairs[i];
            Vec x[4], p[4];
            for (int c = 0; c < 4; ++c) x[c] = at(from, pair.corner[c]), p[c] = at(to, pair.corner[c]) - x[c];
            if (apart(pair, x, p)) continue;
            const double share = safe_share(pair.edges, x, p, left);
            if (share >= 1.0) continue;
            least = std::min(least, share);
            if (meeting) meeting->push_back((int32_t)i), shares->push_back(share);
        }
        return least;
    }

    // Whether the boxes that the features sweep are apart, seen from the first corner.
    static bool apart(const LayerPair& pair, const Vec* x, const Vec* p) {
        const int split = pair.edges ? 2 : 1;
        const double o[3] = {p[0].x, p[0].y, p[0].z};
        bool gap = false;
        for (int k = 0; k < 3; ++k) {
            double l[2] = {1e300, 1e300}, h[2] = {-1e300, -1e300};
            for (int c = 0; c < 4; ++c) {
                const double a = k == 0 ? x[c].x : k == 1 ? x[c].y : x[c].z, q = k == 0 ? p[c].x : k == 1 ? p[c].y : p[c].z, b = a + q - o[k];
                const int side = c >= split;
                l[side] = std::min(l[side], std::min(a, b)), h[side] = std::max(h[side], std::max(a, b));
            }
            gap |= l[0] > h[1] || l[1] > h[0];
        }
        return gap;
    }

    // Moves targets (V, 3) of free vertices so that the straight ways there from positions (V, 3) are free, as little as it can:
    // first the corners of pairs that meet go on together, then all vertices. Pairs that held vertices drive through each other
    // are left out from then on. Returns how many.
    int64_t approach(double* to, double left) {
        const double* from = start.data();
        std::vector<double> shift(3 * mesh.num_vertices), count(mesh.num_vertices);
        int64_t forced = 0;
        for (int round = 0; round < 30; ++round) {
            std::vector<int32_t> meeting;
            std::vector<double> shares;
            if (limit(from, to, left, &meeting, &shares) >= 1.0) break;
            if (round == 29) {
                forced = approach_as_one(from, to, left);
                break;
            }
            std::fill(shift.begin(), shift.end(), 0.0), std::fill(count.begin(), count.end(), 0.0);
            for (size_t i = 0; i < meeting.size(); ++i) bring_together(pairs[meeting[i]], 0.8 * shares[i], from, to, shift.data(), count.data());
            for (int64_t v = 0; v < mesh.num_vertices; ++v)
                for (int k = 0; k < 3 && count[v] > 0.0; ++k) to[3 * v + k] += shift[3 * v + k] / count[v];
        }
        swept = true;
        if (forced) enclose(to);
        else settle(to);
        return forced;
    }

    void bring_together(const LayerPair& pair, double share, const double* from, const double* to, double* shift, double* count) const {
        double mean[3] = {0.0, 0.0, 0.0}, sum = 0.0;
        bool held = false;
        for (int c = 0; c < 4; ++c) held |= fixed[pair.corner[c]] != 0;
        for (int c = 0; c < 4; ++c) {
            const int64_t v = pair.corner[c];
            if (held && !fixed[v]) continue;
            for (int k = 0; k < 3; ++k) mean[k] += to[3 * v + k] - from[3 * v + k];
            sum += 1.0;
        }
        for (int c = 0; c < 4; ++c) {
            const int64_t v = pair.corner[c];
            if (fixed[v]) continue;
            for (int k = 0; k < 3; ++k) shift[3 * v + k] += (1.0 - share) * (mean[k] / sum - (to[3 * v + k] - from[3 * v + k]));
            count[v] += 1.0;
        }
    }

    int64_t approach_as_one(const double* from, double* to, double left) {
        const double share = 0.9 * limit(from, to, left);  // less, so that rounding does not make pairs meet after all
        double mean[3] = {0.0, 0.0, 0.0}, sum = 0.0;
        bool held = false;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) held |= fixed[v] != 0;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) {
            if (held && !fixed[v]) continue;
            for (int k = 0; k < 3; ++k) mean[k] += to[3 * v + k] - from[3 * v + k];
            sum += 1.0;
        }
        for (int64_t v = 0; v < mesh.num_vertices; ++v)
            for (int k = 0; k < 3 && !fixed[v]; ++k) {
                const double own = to[3 * v + k] - from[3 * v + k], common = mean[k] / sum;
                to[3 * v + k] = from[3 * v + k] + common + share * (own - common);
            }
        std::vector<int32_t> meeting;
        std::vector<double> shares;
        limit(from, to, left, &meeting, &shares);
        for (int32_t i : meeting) released.push_back(keys[i]);
        std::sort(released.begin(), released.end());
        return (int64_t)meeting.size();
    }

    // ---- the barrier ---------------------------------------------------------------------------------------------------

    bool contact(const LayerPair& pair, const double* pos, LayerContact& found, Vec* x) const {
        const int split = pair.edges ? 2 : 1;
        for (int c = 0; c < 4; ++c) x[c] = at(pos, pair.corner[c]);
        Vec l[2] = {x[0], x[split]}, h[2] = {x[0], x[split]};
        for (int c = 1; c < 4; ++c) {
            const int side = c >= split;
            l[side] = {std::min(l[side].x, x[c].x), std::min(l[side].y, x[c].y), std::min(l[side].z, x[c].z)};
            h[side] = {std::max(h[side].x, x[c].x), std::max(h[side].y, x[c].y), std::max(h[side].z, x[c].z)};
        }
        const Vec a = l[0] - h[1], b = l[1] - h[0];
        if (std::max(std::max(std::max(a.x, a.y), std::max(a.z, b.x)), std::max(b.y, b.z)) >= pair.reach) return false;
        const double square = pair_distance_sq(pair.edges, x, found.weight);
        if (!(square < pair.reach * pair.reach)) return false;
        // Features that touch are told from those that nearly do no more: the barrier stays finite.
        found.dist = std::max(std::sqrt(square), 1e-12);
        Vec gap = {0.0, 0.0, 0.0};
        for (int c = 0; c < 4; ++c) gap = gap + found.weight[c] * x[c];
        found.gap[0] = gap.x, found.gap[1] = gap.y, found.gap[2] = gap.z;
        return true;
    }

    double energy(const double* pos) {
        const LayerTimer timer{seconds};
        cover(pos);
        double sum = 0.0, slope;
        for (const LayerPair& pair : pairs) {
            LayerContact found;
            Vec x[4];
            if (!contact(pair, pos, found, x)) continue;
            double part = pressure * pair.reach * pair.area * barrier(found.dist / pair.reach);
            if (pair.edges) {
                const Vec normal = cross(x[1] - x[0], x[3] - x[2]);
                part *= fading(dot(normal, normal), pair.parallel, &slope);
            }
            sum += part;
        }
        return sum;
    }

    // Forces by vertex, and rows n (12) such that the sum of their outer products is a positive curvature; how many rows.
    int64_t model(const double* pos) {
        const LayerTimer timer{seconds};
        cover(pos);
        settle(pos);
        contacts.clear(), rows.clear(), normals.clear();
        std::fill(gradient.begin(), gradient.end(), 0.0), std::fill(own.begin(), own.end(), 0.0);
        gradient.resize(3 * mesh.num_vertices, 0.0), own.resize(6 * mesh.num_vertices, 0.0);
        for (size_t i = 0; i < pairs.size(); ++i) {
            const LayerPair& pair = pairs[i];
            LayerContact found;
            Vec x[4];
            if (!contact(pair, pos, found, x)) continue;
            found.pair = (int32_t)i;
            contacts.push_back(found);
            add_model(pair, found, x);
        }
        return (int64_t)contacts.size();
    }

    void add_model(const LayerPair& pair, const LayerContact& found, const Vec* x) {
        const double s = found.dist / pair.reach, scale = pressure * pair.area;
        double share = 1.0, fade = 0.0;
        Vec by_first = {0.0, 0.0, 0.0}, by_second = by_first;
        if (pair.edges) {
            const Vec u = x[1] - x[0], v = x[3] - x[2], normal = cross(u, v);
            share = fading(dot(normal, normal), pair.parallel, &fade);
            if (fade > 0.0) {
                const double force = 2.0 * fade * scale * pair.reach * barrier(s);
                by_first = force * cross(v, normal), by_second = force * cross(normal, u);
            }
        }
        const double push = share * scale * barrier_slope(s) / found.dist;
        const double stiff = std::sqrt(share * scale / pair.reach * barrier_curvature(s)) / found.dist;
        for (int c = 0; c < 4; ++c) {
            const int64_t v = pair.corner[c];
            double n[3];
            for (int k = 0; k < 3; ++k) {
                gradient[3 * v + k] += push * found.weight[c] * found.gap[k];
                n[k] = stiff * found.weight[c] * found.gap[k];
                normals.push_back(n[k]);
            }
            double* upper = own.data() + 6 * v;
            upper[0] += n[0] * n[0], upper[1] += n[0] * n[1], upper[2] += n[0] * n[2];
            upper[3] += n[1] * n[1], upper[4] += n[1] * n[2], upper[5] += n[2] * n[2];
            if (fade > 0.0) {
                const Vec turn = c < 2 ? by_first : by_second;
                const double sign = c % 2 ? 1.0 : -1.0;
                gradient[3 * v] += sign * turn.x, gradient[3 * v + 1] += sign * turn.y, gradient[3 * v + 2] += sign * turn.z;
            }
            rows.push_back(row.empty() ? (int32_t)v : row[v]);
        }
    }
};

}  // namespace
