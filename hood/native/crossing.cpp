// Where triangles pass through each other, and how far skin sticks out: see hood/mesh/penetration/crossing.py and hood/mesh/penetration/exposure.py.
//
// To be compiled without contracted products: faces that share an edge must compute the same signs for it, to the last bit.
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <initializer_list>
#include <numeric>
#include <vector>

#include "eights.h"
#include "halving.h"
#include "lanes.h"
#include "vector.h"

extern "C" {

// Rows that were found, unique and sorted; where there are more than there is room for, they are counted alone.
struct Rows {
    int64_t room[3], found[3];
    int64_t *pairs, *first_edges, *second_edges;  // (., 2), (., 3), (., 3)
};
}

namespace {

constexpr int EDGE[3][2] = {{0, 1}, {1, 2}, {0, 2}};  // of a triangle whose corners ascend

inline double axis(Vec v, int k) { return k == 0 ? v.x : k == 1 ? v.y : v.z; }
inline double norm(Vec v) { return std::sqrt(dot(v, v)); }
inline int sign(double v) { return (v > 0.0) - (v < 0.0); }

// A triangle with its corners in the order of their numbers, and its unit normal: zero without an area.
struct Triangle {
    int64_t number, vertex[3];
    Vec corner[3], normal;
};

inline Vec lane_of(const double* table, int i) { return {table[i], table[LANES + i], table[2 * LANES + i]}; }

Triangle triangle(const Eights& e, int64_t leaf, int i) {
    Triangle t;
    t.number = e.order[LANES * leaf + i];
    for (int c = 0; c < 3; ++c) {
        t.vertex[c] = e.vertex[LANES * (3 * leaf + c) + i];
        t.corner[c] = lane_of(e.corner + LANES * (9 * leaf + 3 * c), i);
    }
    t.normal = lane_of(normals(e, leaf), i);
    return t;
}

// Sides of a plane on which the corners lie.
inline void sides(const Triangle& t, const Triangle& plane, double touch, int* side) {
    for (int c = 0; c < 3; ++c) {
        const double height = dot(t.corner[c] - plane.corner[0], plane.normal);
        side[c] = std::fabs(height) > touch ? sign(height) : 0;
    }
}

// Whether a line passes the edges of a triangle on one side all the way round.
inline bool inside(int a, int b, int c) {
    c = -c;  // the third edge runs against the way round
    return (a >= 0 && b >= 0 && c >= 0) || (a <= 0 && b <= 0 && c <= 0);
}

// Triangles of a leaf that share no vertex with one of another leaf.
inline uint64_t strangers(const Eights& e, int64_t leaf, int i, int64_t other) {
    return lanes_of([&](int at) {
        NN same = NN{};
        for (int c = 0; c < 3; ++c)
            for (int d = 0; d < 3; ++d)
                same |= load<NN>(e.vertex + LANES * (3 * other + d) + at) == e.vertex[LANES * (3 * leaf + c) + i];
        return ~same;
    });
}

// Triangles of a leaf of b with corners on both sides of the plane of a triangle of a, which has corners on both sides of theirs.
inline uint64_t straddling(const Eights& a, int64_t leaf, int i, const Eights& b, int64_t other, double touch) {
    const double *corner = a.corner + 9 * LANES * leaf + i, *normal = normals(a, leaf) + i;
    const double* corners = b.corner + 9 * LANES * other;
    const uint64_t first = lanes_of([&](int at) {
        const auto theirs = [&](int c, int k) { return load<VN>(corners + LANES * (3 * c + k) + at); };
        return on_both_sides(theirs, [&](int k) { return corner[LANES * k]; }, [&](int k) { return normal[LANES * k]; }, touch);
    });
    if (!first) return 0;
    const double* up = normals(b, other);
    return first & lanes_of([&](int at) {
        const auto own = [&](int c, int k) { return every(corner[LANES * (3 * c + k)]); };
        const auto point = [&](int k) { return load<VN>(corners + LANES * k + at); };
        return on_both_sides(own, point, [&](int k) { return load<VN>(up + LANES * k + at); }, touch);
    });
}

// Middle of the finite ones of some points, and the extent of the box around them.
void locate(const Eights& first, const Eights& second, double* origin, double* extent) {
    double low[3] = {INFINITY, INFINITY, INFINITY}, high[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (const Eights* e : {&first, &second})
        for (int64_t i = 0; i < e->num_vertices; ++i) {
            const double *p = e->pos + 3 * i, sum = (p[0] - p[0]) + (p[1] - p[1]) + (p[2] - p[2]);
            if (!(sum == 0.0)) continue;
            for (int k = 0; k < 3; ++k) low[k] = std::min(low[k], p[k]), high[k] = std::max(high[k], p[k]);
        }
    *extent = 0.0;
    for (int k = 0; k < 3; ++k) {
        origin[k] = low[k] <= high[k] ? 0.5 * low[k] + 0.5 * high[k] : 0.0;
        *extent = low[k] <= high[k] ? std::max(*extent, high[k] - low[k]) : *extent;
    }
}

template <int WIDTH> void sort_rows(int64_t* table, int64_t* count) {
    struct Row {
        int64_t value[WIDTH];
        bool operator<(const Row& other) const { return std::lexicographical_compare(value, value + WIDTH, other.value, other.value + WIDTH); }
        bool operator==(const Row& other) const { return std::equal(value, value + WIDTH, other.value); }
    };
    Row *begin = (Row*)table, *end = begin + *count;
    std::sort(begin, end);
    *count = std::unique(begin, end) - begin;
}

// Squared distance from p to a triangle and the weights of its nearest point: exactly 0 for corners that have no part in it.
double closest(Vec p, Vec a, Vec b, Vec c, double* weights) {
    const Vec corner[3] = {a, b, c};
    double best = INFINITY;
    for (int i = 0; i < 3; ++i) {
        const int j = (i + 1) % 3;
        const Vec along = corner[j] - corner[i], from = p - corner[i];
        const double length_sq = dot(along, along);
        double share = dot(from, along) / (length_sq > 0.0 ? length_sq : 1.0);
        share = share < 0.0 ? 0.0 : share > 1.0 ? 1.0 : share;
        const Vec offset = from - share * along;
        const double dist_sq = dot(offset, offset);
        if (!(dist_sq < best)) continue;
        best = dist_sq;
        weights[i] = 1.0 - share, weights[j] = share, weights[(i + 2) % 3] = 0.0;
    }
    const Vec first = b - a, second = c - a, offset = p - a, normal = cross(first, second);
    const double area_sq = dot(normal, normal);
    if (area_sq <= 256.0 * EPS * EPS * dot(first, first) * dot(second, second)) return best;
    const double scale = 1.0 / area_sq, y = dot(cross(offset, second), normal) * scale, z = dot(cross(first, offset), normal) * scale;
    const double x = 1.0 - y - z;
    if (!(x > 0.0 && y > 0.0 && z > 0.0)) return best;
    weights[0] = x, weights[1] = y, weights[2] = z;
    const Vec gap = p - (x * a + y * b + z * c);
    return dot(gap, gap);
}

// Some of the cloth's faces in eights, for the one nearest to a point.
struct Pile {
    const double* pos;
    const int64_t* faces;
    std::vector<int64_t> face;
    std::vector<double> boxes, groups;
    mutable std::vector<double> away;

    Pile(const double* pos, const int64_t* faces, std::vector<int64_t> chosen) : pos(pos), faces(faces), face(std::move(chosen)) {
        const int64_t count = (int64_t)face.size(), leaves = (count + LANES - 1) / LANES, wide = (leaves + LANES - 1) / LANES;
        boxes.resize(6 * LANES * leaves), groups.resize(6 * LANES * wide), away.resize(LANES * wide);
        for (std::vector<double>* sides : {&boxes, &groups})
            for (size_t i = 0; i < sides->size(); ++i) (*sides)[i] = i / (3 * LANES) % 2 ? -INFINITY : INFINITY;
        for (int64_t i = 0; i < count; ++i)
            for (int k = 0; k < 3; ++k) {
                double* side = boxes.data() + LANES * (6 * (i / LANES) + k) + i % LANES;
                for (int c = 0; c < 3; ++c) {
                    const double x = pos[3 * faces[3 * face[i] + c] + k];
                    side[0] = std::min(side[0], x), side[3 * LANES] = std::max(side[3 * LANES], x);
                }
            }
        for (int64_t i = 0; i < leaves; ++i) surround(boxes.data() + 6 * LANES * i, groups.data() + 6 * LANES * (i / LANES), i % LANES);
    }

    // Squared distances to eight boxes; infinite where there is none.
    static void box_dist_sq(const double* sides, Vec p, double* away) {
        for (int i = 0; i < LANES; i += AT_ONCE) {
            VN sum = every(0.0);
            for (int k = 0; k < 3; ++k) {
                const VN gap = higher(load<VN>(sides + LANES * k + i) - axis(p, k), axis(p, k) - load<VN>(sides + LANES * (3 + k) + i));
                const VN out = higher(gap, every(0.0));
                sum += out * out;
            }
            store(away + i, sum);
        }
    }

    // The nearest face within a squared distance, the first one of several, or -1; the squared distance and weights of its point.
    int64_t nearest(Vec p, double& best, double* weights) const {
        double least = INFINITY;
        int64_t likely = -1, number = -1;
        for (size_t i = 0; i < away.size(); i += LANES) box_dist_sq(groups.data() + 6 * i, p, away.data() + i);
        for (size_t i = 0; i < away.size(); ++i)
            if (away[i] < least) least = away[i], likely = (int64_t)i;
        if (!(least <= best * (1.0 + 1e-9))) return -1;
        const auto look_into = [&](int64_t leaf) {
            double gap[LANES];
            box_dist_sq(boxes.data() + 6 * LANES * leaf, p, gap);
            for (int lane = 0; lane < LANES; ++lane) {
                if (!(gap[lane] <= best * (1.0 + 1e-9))) continue;
                const int64_t f = face[LANES * leaf + lane], *corner = faces + 3 * f;
                double at_point[3];
                const double dist_sq = closest(p, at(pos, corner[0]), at(pos, corner[1]), at(pos, corner[2]), at_point);
                if (!(dist_sq < best || (dist_sq == best && (number < 0 || f < number)))) continue;
                best = dist_sq, number = f;
                std::copy(at_point, at_point + 3, weights);
            }
        };
        // The leaf whose box is nearest first: it leaves few others to look at.
        look_into(likely);
        for (size_t i = 0; i < away.size(); ++i)
            if (away[i] <= best * (1.0 + 1e-9) && (int64_t)i != likely) look_into((int64_t)i);
        return number;
    }
};

// Parts of a mesh that hang together.
struct Parts {
    std::vector<int32_t> above;

    explicit Parts(int64_t count) : above(count) { std::iota(above.begin(), above.end(), 0); }
    int32_t root(int64_t i) {
        while (above[i] != i) above[i] = above[above[i]], i = above[i];
        return (int32_t)i;
    }
    void join(int64_t a, int64_t b) { above[root(a)] = root(b); }
};

// What passes through what between the leaves of a first mesh and a second one, which is the same where pairs of one are asked for.
struct Search {
    const Eights &first, &second;
    const Levels levels;
    const int64_t same;
    const double touch;
    Rows& rows;

    // Threads share the tables, which are sorted afterwards; rows that there is no room for are counted alone.
    void put(int which, int64_t* table, std::initializer_list<int64_t> row) const {
        const int64_t place = __atomic_fetch_add(rows.found + which, 1, __ATOMIC_RELAXED);
        if (place < rows.room[which]) std::copy(row.begin(), row.end(), table + (int64_t)row.size() * place);
    }

    void examine(const Triangle& a, const Triangle& b) const {
        int side[3], other_side[3], turn[3][3];
        sides(a, b, touch, side), sides(b, a, touch, other_side);
        for (int i = 0; i < 3; ++i) {
            const Vec start = a.corner[EDGE[i][0]], along = a.corner[EDGE[i][1]] - start;
            const Vec moved[3] = {b.corner[0] - start, b.corner[1] - start, b.corner[2] - start};
            for (int j = 0; j < 3; ++j) turn[i][j] = sign(dot(along, cross(moved[EDGE[j][0]], moved[EDGE[j][1]])));
        }
        bool crossed = false;
        for (int i = 0; i < 3; ++i) {
            const int *ends = EDGE[i], here = side[ends[0]] * side[ends[1]], there = other_side[ends[0]] * other_side[ends[1]];
            if (here < 0 && inside(turn[i][0], turn[i][1], turn[i][2])) {
                crossed = true;
                put(1, rows.first_edges, {a.vertex[ends[0]], a.vertex[ends[1]], b.number});
            }
            if (there < 0 && inside(turn[0][i], turn[1][i], turn[2][i])) {
                crossed = true;
                put(2, rows.second_edges, {b.vertex[ends[0]], b.vertex[ends[1]], a.number});
            }
        }
        if (crossed) put(0, rows.pairs, {a.number, b.number});
    }

    void compare(int64_t leaf, int64_t other) const {
        const double* boxes = second.boxes + 6 * LANES * other;
        const uint64_t close = overlapped(first.boxes + 6 * LANES * leaf, box_in(second.groups + 6 * LANES * (other / LANES), other % LANES));
        each_lane(close, [&](int i) {
            uint64_t met = overlapped(boxes, box_in(first.boxes + 6 * LANES * leaf, i));
            // Of two triangles of one leaf once.
            if (same && leaf == other) met &= ((uint64_t)1 << 8 * i) - 1;
            if (met && same) met &= strangers(first, leaf, i, other);
            if (met) met &= straddling(first, leaf, i, second, other, touch);
            each_lane(met, [&](int j) {
                const Triangle a = triangle(first, leaf, i), b = triangle(second, other, j);
                if (same && b.number < a.number) examine(b, a);
                else examine(a, b);
            });
        });
    }

    void look_at(int64_t leaf) const {
        const Box around = box_in(first.groups + 6 * LANES * (leaf / LANES), leaf % LANES);
        visit_leaves(second.groups, levels, same ? leaf + 1 : second.num_leaves,
                     [&](const double* boxes) { return overlapped(boxes, around); }, [&](int64_t other) { compare(leaf, other); });
    }
};

}  // namespace

extern "C" {

// Everything about a mesh that depends on the topology, from centres (F, 3) of the faces; ``order`` holds their numbers.
void crossing_order(Eights* e, const double* centre) {
    order_leaves(e->order, (int32_t)e->num_faces, LANES, centre);
    for (int64_t i = 0; i < LANES * e->num_leaves; ++i) {
        int64_t vertex[3] = {0, 0, 0};
        if (i < e->num_faces) std::copy(e->faces + 3 * (int64_t)e->order[i], e->faces + 3 * (int64_t)e->order[i] + 3, vertex);
        else e->order[i] = -1;
        std::sort(vertex, vertex + 3);
        for (int c = 0; c < 3; ++c) e->vertex[LANES * (3 * (i / LANES) + c) + i % LANES] = (int32_t)vertex[c];
    }
}

// Crossings of two meshes, or of pairs of one mesh's faces without a common vertex, the smaller number first (``same``). The leaves
// of the first mesh are looked at in parts, by threads; what is found does not depend on it.
void crossing_find(const Eights* first, const Eights* second, int64_t same, double touch_share, int64_t parts, Rows* rows) {
    constexpr int64_t IN_TURN = 4;  // leaves that a part takes before it is the next one's turn
    for (int k = 0; k < 3; ++k) rows->found[k] = 0;
    if (!first->num_leaves || !second->num_leaves) return;
    double origin[3], touch;
    locate(*first, *second, origin, &touch);
    place(*first, origin, parts);
    if (!same) place(*second, origin, parts);
    const Search search{*first, *second, Levels(second->num_leaves), same, touch * touch_share, *rows};
    for_parts(parts, [&](int64_t part) {
        for (int64_t begin = IN_TURN * part; begin < first->num_leaves; begin += IN_TURN * parts)
            for (int64_t leaf = begin; leaf < std::min(begin + IN_TURN, first->num_leaves); ++leaf) search.look_at(leaf);
    });
    for (int k = 0; k < 3; ++k)
        if (rows->found[k] > rows->room[k]) return;
    sort_rows<2>(rows->pairs, rows->found), sort_rows<3>(rows->first_edges, rows->found + 1), sort_rows<3>(rows->second_edges, rows->found + 2);
}

// What is known of cloth, of skin and of how they cut, and the rules of hood/mesh/penetration/exposure.py.
struct Depth {
    int64_t num_vertices, num_faces, num_edges, num_skin, num_pairs, num_cuts;
    const double* pos;                // (V, 3) m
    const int64_t *faces, *edges;     // (F, 3), (E, 2) unique and sorted
    const uint8_t *open_edge, *on_rim;  // (F, 3), (V)
    const int32_t* order;             // (F) faces in an order in which neighbours lie together
    const double* skin_pos;           // (W, 3) m
    const int64_t *skin_faces, *first, *around;  // (G, 3), (W + 1), (3G) faces around each vertex, ascending
    const int64_t *pairs, *cuts;      // (., 2), (., 3) crossing faces; edges of the cloth and faces of the skin; unique and sorted
    double reach, behind, nearest;
};
}

namespace {

// Which vertices of the cloth are under the skin: see hood.mesh.penetration.exposure.sunken.
std::vector<uint8_t> sunken(const Depth& d) {
    Parts parts(d.num_vertices);
    for (int64_t e = 0, at_cut = 0; e < d.num_edges; ++e) {
        const int64_t *edge = d.edges + 2 * e, *cut = d.cuts + 3 * at_cut;
        if (at_cut < d.num_cuts && cut[0] == edge[0] && cut[1] == edge[1])
            while (at_cut < d.num_cuts && d.cuts[3 * at_cut] == edge[0] && d.cuts[3 * at_cut + 1] == edge[1]) ++at_cut;
        else parts.join(edge[0], edge[1]);
    }
    std::vector<int32_t> votes(d.num_vertices, 0);
    for (int64_t begin = 0, end; begin < d.num_cuts; begin = end) {
        const int64_t* edge = d.cuts + 3 * begin;
        double least = 0.0, most = 0.0;
        int side[2] = {0, 0};
        for (end = begin; end < d.num_cuts && d.cuts[3 * end] == edge[0] && d.cuts[3 * end + 1] == edge[1]; ++end) {
            const int64_t* corner = d.skin_faces + 3 * d.cuts[3 * end + 2];
            const Vec a = at(d.skin_pos, corner[0]), normal = cross(at(d.skin_pos, corner[1]) - a, at(d.skin_pos, corner[2]) - a);
            const double height = dot(at(d.pos, edge[0]) - a, normal), other = dot(at(d.pos, edge[1]) - a, normal);
            const double along = height / (height - other);  // the ends are on two sides of the plane
            if (end == begin || along < least) least = along, side[0] = sign(height);
            if (end == begin || along > most) most = along, side[1] = sign(other);
        }
        for (int k = 0; k < 2; ++k) votes[parts.root(edge[k])] += side[k];
    }
    std::vector<uint8_t> under(d.num_vertices);
    for (int64_t v = 0; v < d.num_vertices; ++v) under[v] = votes[parts.root(v)] < 0;
    return under;
}

// Area-weighted normal at a vertex of the skin, not of unit length.
Vec normal_at(const Depth& d, int64_t vertex) {
    Vec sum{0.0, 0.0, 0.0};
    for (int64_t i = d.first[vertex]; i < d.first[vertex + 1]; ++i) {
        const int64_t* corner = d.skin_faces + 3 * d.around[i];
        const Vec a = at(d.skin_pos, corner[0]);
        sum = sum + cross(at(d.skin_pos, corner[1]) - a, at(d.skin_pos, corner[2]) - a);
    }
    return sum;
}

bool is_on_rim(const Depth& d, int64_t face, const double* weights) {
    bool away[3], rim = false, on_edge = false;
    for (int c = 0; c < 3; ++c) away[c] = weights[c] == 0.0;
    for (int c = 0; c < 3; ++c) {
        on_edge |= away[(c + 2) % 3] && d.open_edge[3 * face + c];
        rim |= !away[c] && d.on_rim[d.faces[3 * face + c]];
    }
    return on_edge || (away[0] + away[1] + away[2] == 2 && rim);
}

// A vertex of the skin that may be above the cloth, and the cloth's point nearest to it.
struct Above {
    double dist;
    int64_t vertex;
    Vec point;
};

// Coordinates in rows, in eights, to be compared with a point together.
struct Cloud {
    std::vector<double> row[3];

    Cloud(const double* pos, int64_t count) {
        for (int k = 0; k < 3; ++k) {
            row[k].assign((count + LANES - 1) / LANES * LANES, INFINITY);
            for (int64_t i = 0; i < count; ++i) row[k][i] = pos[3 * i + k];
        }
    }
    // Whether any of them is nearer to p than a distance.
    bool any_within(Vec p, double dist) const {
        constexpr size_t STEP = 64 * LANES;
        for (size_t begin = 0; begin < row[0].size(); begin += STEP) {
            VN least = every(INFINITY);
            for (size_t i = begin; i < std::min(begin + STEP, row[0].size()); i += AT_ONCE) {
                const VN x = load<VN>(&row[0][i]) - p.x, y = load<VN>(&row[1][i]) - p.y, z = load<VN>(&row[2][i]) - p.z;
                least = lower(x * x + y * y + z * z, least);
            }
            double dist_sq = least[0];
            for (int i = 1; i < AT_ONCE; ++i) dist_sq = std::min(dist_sq, least[i]);
            if (std::sqrt(dist_sq) < dist) return true;
        }
        return false;
    }
};

std::vector<Above> candidates(const Depth& d, const Pile& suspects) {
    Box all_around{{INFINITY, INFINITY, INFINITY}, {-INFINITY, -INFINITY, -INFINITY}};
    for (size_t i = 0; i < suspects.groups.size(); ++i) {
        const size_t k = i / LANES % 6;
        if (k < 3) all_around.low[k] = std::min(all_around.low[k], suspects.groups[i]);
        else all_around.high[k - 3] = std::max(all_around.high[k - 3], suspects.groups[i]);
    }
    std::vector<Above> found;
    for (int64_t v = 0; v < d.num_skin; ++v) {
        const Vec p = at(d.skin_pos, v);
        bool close = true;
        for (int k = 0; k < 3; ++k) close &= axis(p, k) >= all_around.low[k] - d.reach && axis(p, k) <= all_around.high[k] + d.reach;
        if (!close) continue;
        const double reach = d.reach * (1.0 + 1e-9);
        double best = reach * reach, weights[3];
        const int64_t face = suspects.nearest(p, best, weights), *corner = d.faces + 3 * face;
        if (face < 0 || is_on_rim(d, face, weights)) continue;
        const Vec point = weights[0] * at(d.pos, corner[0]) + weights[1] * at(d.pos, corner[1]) + weights[2] * at(d.pos, corner[2]);
        const Vec normal = normal_at(d, v);
        const double dist = std::sqrt(best);
        if (-dot(point - p, normal) > d.behind * dist * norm(normal)) found.push_back({dist, v, point});
    }
    return found;
}
}

extern "C" {

// Largest height of a vertex of the skin above the cloth: see hood.mesh.penetration.exposure.skin_depth.
double crossing_depth(const Depth* depth) {
    const Depth& d = *depth;
    std::vector<uint8_t> suspect(d.num_faces, 0);
    for (int64_t i = 0; i < d.num_pairs; ++i) suspect[d.pairs[2 * i]] = 1;
    const std::vector<uint8_t> under = sunken(d);
    for (int64_t f = 0; f < d.num_faces; ++f) suspect[f] |= under[d.faces[3 * f]] & under[d.faces[3 * f + 1]] & under[d.faces[3 * f + 2]];
    std::vector<int64_t> chosen[2];
    for (int64_t i = 0; i < d.num_faces; ++i) chosen[suspect[d.order[i]]].push_back(d.order[i]);
    std::vector<Above> found = candidates(d, Pile(d.pos, d.faces, std::move(chosen[1])));
    if (found.empty()) return 0.0;
    // From the highest one down: the first that is above the cloth is the answer.
    std::sort(found.begin(), found.end(), [](const Above& a, const Above& b) { return a.dist > b.dist || (a.dist == b.dist && a.vertex < b.vertex); });
    const Cloud skin(d.skin_pos, d.num_skin);
    const Pile others(d.pos, d.faces, std::move(chosen[0]));
    for (const Above& above : found) {
        if (skin.any_within(above.point, d.nearest * above.dist)) continue;
        // Where another face is nearer still, the vertex is under cloth that is not cut.
        double best = above.dist * above.dist, weights[3];
        const int64_t other = others.nearest(at(d.skin_pos, above.vertex), best, weights);
        if (other < 0 || !(std::sqrt(best) < above.dist * (1.0 - 1e-9))) return above.dist;
    }
    return 0.0;
}
}
