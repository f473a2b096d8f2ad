// Cloth near cloth: a list of pairs of features that may come near each other, a barrier on their distance, and how far vertices
// may move along straight lines before two features meet. See hood/mesh/cloth_proximity.py and hood/energies/self_contact.py.
//
// A pair is a vertex and a face, or two edges, without a common vertex. The list is made for straight ways: all pairs that can be
// within their reach while every vertex is within its margin of its place on the way, all of them equally far along, are in the list.
// So sums over it are sums over all pairs, and no two features can meet that are not in it. Where a vertex leaves its margin the
// list is made anew. A pair keeps a lower bound of its distance, which falls by what the cloth moves; only where it comes within
// reach the distance is measured again. The numbering is the cloth's own.
#pragma once
#include <algorithm>
#include <atomic>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <ctime>
#include <vector>

#include "layer_search.h"
#include "layer_view.h"
#include "layer_way.h"
#include "vector.h"

namespace {

struct LayerPair {
    int32_t corner[4];  // a vertex and a face, or two edges
    int32_t edges;      // 1 for two edges
    double reach, area, parallel;  // m; m^2; m^4: square of the edges' cross product below which the barrier fades
};

// A pair within its reach.
struct LayerContact {
    int32_t pair;
    double weight[4], dist;  // the gap is the sum of weight times corner
    double gap[3];
};

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

// Processor time of this thread [s].
inline double thread_seconds() {
    timespec now;
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return (double)now.tv_sec + 1e-9 * (double)now.tv_nsec;
}

// What the time is spent on; a part within another is not counted for the other.
struct LayerClock {
    enum Part { OTHER, SEARCH, LIMIT, ENERGY, MODEL, PARTS };
    double seconds[PARTS] = {};
    Part part = OTHER;
    double since = 0.0;

    Part turn(Part next) {
        const double now = thread_seconds();
        if (part != OTHER) seconds[part] += now - since;
        const Part before = part;
        part = next, since = now;
        return before;
    }
};

struct LayerTimer {
    LayerClock& clock;
    LayerClock::Part before;
    LayerTimer(LayerClock& its, LayerClock::Part part) : clock(its), before(its.turn(part)) {}
    ~LayerTimer() { clock.turn(before); }
};

struct Layers {
    LayerMesh mesh;
    double pressure = 0.0;  // Pa
    bool between = false;   // pairs of two garments alone
    bool whole = false;     // pairs of fixed vertices as well
    std::vector<uint8_t> fixed, careful;  // (V), (V) or none: vertices that keep a distance on their way
    std::vector<double> margin;      // (V) m, how far vertices may be off their ways
    std::vector<uint64_t> released;  // sorted keys of pairs that are left out
    std::vector<LayerPair> pairs;
    std::vector<uint64_t> keys;
    std::vector<double> bounds;  // of the distances of the pairs, and what the cloth had moved when they were found [m]
    std::vector<LayerContact> contacts;  // of the last model
    int64_t threads = 1;
    std::vector<double> start, ahead;  // (3 V) where the step begins, and where it may end
    std::vector<double> resort;        // (3 V) where ways lead that are known to be free; or none
    // The ways that the list is for, the margins then, where the cloth was last and how far it has moved since.
    std::vector<double> from, to, room, last;
    bool moving = false;  // whether the ways lead anywhere
    double moved = 0.0, most_reach = 0.0, most_room = 0.0;
    bool begun = false;   // whether there is a list
    bool known_apart = false;  // nothing is near or through anything where the step begins
    int64_t searches = 0, refreshes = 0, crossed = 0;  // pairs of faces that are crossed where it begins
    LayerClock clock;  // what solvers do with the rows is no part of it
    bool overflowed = false;  // cloth so crumpled, or torn, that nearly everything is near everything: no list
    // Pairs whose boxes overlap; written without a branch, which would be guessed wrongly as often as not.
    struct Candidates {
        std::vector<Candidate> list;
        size_t count = 0;

        void offer(const Candidate& pair, bool taken) {
            list[count] = pair;
            count += taken;
        }
        void make_room(size_t more) {
            if (list.size() < count + more) list.resize(2 * (count + more));
        }
    };
    struct Listed {
        std::vector<LayerPair> pairs;
        std::vector<uint64_t> keys;
        std::vector<double> bounds;
        std::vector<std::array<int32_t, 2>> found_at;  // places of the faces of the pairs
    };
    // What a part of a search finds, of points and faces and of edges: of faces without a common vertex, and of those with one.
    struct Found {
        Candidates candidates[2], beside[2];
        Listed listed[2], listed_beside[2];
        std::vector<uint64_t> released;
        int64_t looked_at, crossed;
        int64_t told;  // how many candidates the tally knows of

        int64_t count() const { return candidates[0].count + candidates[1].count + beside[0].count + beside[1].count; }
    };
    // Memory that the next search of a thread uses again.
    struct Memory {
        std::vector<Found> found;
        LayerTree tree;
        std::vector<double> wide, middle, half;  // (V), (4 V) where vertices are halfway, and half of their ways
    };
    Memory* memory = nullptr;  // of the search that goes on
    std::vector<std::array<int32_t, 2>> found_at;  // of the pairs that the last search has found of a kind
    // What all parts of a search have found together, told after every so many pairs of faces: where that is too much, all end.
    struct Tally {
        std::atomic<int64_t> looked_at{0}, count{0};
        std::atomic<bool> over{false};
    };
    static constexpr int64_t NOW_AND_THEN = 256;
    std::vector<int32_t> strays;
    // For the solver.
    LayerView view = {};
    std::vector<double> here, there, gradient, own;  // (3 V) twice, (3 V), (6 V)
    std::vector<int32_t> row, rows;                  // (V) number of a vertex in the solver, (N, 4)
    int32_t num_rows = 0;                            // those from this number on do not move
    std::vector<double> normals;                     // (N, 16)
    std::vector<float> normals_single;

    uint64_t key(int32_t edges, int64_t first, int64_t second) const {
        return edges ? ((uint64_t)1 << 63) | ((uint64_t)first * mesh.num_edges + second) : (uint64_t)first * mesh.num_faces + second;
    }

    // ---- the list --------------------------------------------------------------------------------------------------------

    static constexpr int64_t MOST_PAIRS = 4000000;
    static constexpr int64_t MOST_LOOKS = 300;  // at pairs of faces, for each face: beyond it the cloth is torn
    static constexpr double SLACK = 1e-9;       // m, more than rounding makes of a distance of any but nearly parallel edges: 1e-7
    static constexpr int64_t PARTS = 8;         // of a search, for each thread
    static constexpr size_t FEW = 16;           // at most one of so many vertices is looked for alone

    // The list of straight ways between positions (V, 3), or of the pairs of some vertices alone.
    void search(const double* begin, const double* end, const std::vector<uint8_t>* some = nullptr) {
        const LayerTimer timer(clock, LayerClock::SEARCH);
        const bool first = !begun && !known_apart && !some;
        begun = true;
        const int64_t size = 3 * mesh.num_vertices;
        pairs.clear(), keys.clear(), bounds.clear(), contacts.clear();
        ++searches;
        from.assign(begin, begin + size), to.assign(end, end + size);
        moving = std::memcmp(begin, end, sizeof(double) * size) != 0, moved = 0.0;
        last = from, room = margin;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) most_reach = std::max(most_reach, mesh.reach[v]);
        overflowed = overflowed || !finite();
        if (overflowed || mesh.num_faces < 2) return;
        make_boxes();
        if (some) return fill_around(*some);
        // Parts that are done early leave the others to the threads; what is found does not depend on their number.
        const int64_t parts = std::min(threads > 1 ? PARTS * threads : 1, MOST_PARTS);
        const auto visit = [&](int64_t part, const auto& look) {
            memory->tree.pairs(*mesh.topology, range_of(mesh.topology->steps.size(), part, parts), look);
        };
        fill(parts, visit, first, nullptr);
    }

    // Adds the pairs of some vertices.
    void fill_around(const std::vector<uint8_t>& some) {
        const auto visit = [&](int64_t, const auto& look) {
            for (int64_t i = 0; i < mesh.num_faces; ++i) {
                if (!any_of(corners_at(i), 3, some)) continue;
                memory->tree.around(memory->tree.face[i], 0, 0, mesh.num_faces, [&](int64_t j) {
                    if (i != j && (i < j || !any_of(corners_at(j), 3, some))) look(i, j);
                });
            }
        };
        fill(1, visit, false, &some);
    }

    // The list where few vertices have left their margins: their pairs alone are looked for anew, on straight ways between
    // positions (V, 3) that are ``shifts`` off the ways of the list, or off their ends where those are what counts from now on.
    void search_again(const double* begin, const double* end, const Vec* shifts, bool along) {
        const LayerTimer timer(clock, LayerClock::SEARCH);
        ++refreshes;
        if (!along) from = to, moving = false;
        std::vector<uint8_t> stray(mesh.num_vertices, 0);
        for (int32_t v : strays) {
            const Vec one = at(begin, v) - shifts[0], other = at(end, v) - shifts[1], way = other - one, middle = 0.5 * (one + other);
            put(from, v, along ? one : middle), put(to, v, along ? other : middle);
            stray[v] = 1, room[v] = margin[v] + (along ? 0.0 : std::sqrt(dot(way, way)));
        }
        overflowed = overflowed || !finite();
        if (!overflowed) {
            keep([&](size_t i) { return !any_of(pairs[i].corner, 4, stray); });
            contacts.clear();
            make_boxes();
            fill_around(stray);
        }
        if (overflowed) pairs.clear(), keys.clear(), bounds.clear();
    }

    static void put(std::vector<double>& to, int64_t v, Vec x) { to[3 * v] = x.x, to[3 * v + 1] = x.y, to[3 * v + 2] = x.z; }

    static bool any_of(const int32_t* corner, int count, const std::vector<uint8_t>& marked) {
        bool any = false;
        for (int c = 0; c < count; ++c) any |= marked[corner[c]] != 0;
        return any;
    }

    void make_boxes() {
        thread_local Memory kept;
        memory = &kept;
        std::vector<double>&wide = kept.wide, &middle = kept.middle, &half = kept.half;
        wide.resize(mesh.num_vertices), middle.resize(4 * mesh.num_vertices), half.resize(4 * mesh.num_vertices);
        most_room = 0.0;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) {
            most_room = std::max(most_room, room[v]), wide[v] = room[v] + 0.5 * mesh.reach[v] + SLACK;
            for (int64_t k = 0; k < 3; ++k) {
                const double a = from[3 * v + k], b = to[3 * v + k];
                middle[4 * v + k] = 0.5 * (a + b), half[4 * v + k] = 0.5 * (b - a);
            }
        }
        kept.tree.enclose(from.data(), to.data(), wide);
        kept.tree.build(mesh, threads);
    }

    // Adds pairs of features of the pairs of faces that are visited; where ``stray`` is given, only those with such a vertex.
    template <class Faces> void fill(int64_t parts, const Faces& visit, bool first, const std::vector<uint8_t>* stray) {
        std::vector<Found>& found = memory->found;
        if ((int64_t)found.size() < parts) found.resize(parts);
        Tally tally;
        tally.looked_at = stray ? 0 : mesh.topology->num_beside;
        for_parts(parts, [&](int64_t part) {
            Found& mine = found[part];
            mine.looked_at = mine.crossed = mine.told = 0, mine.released.clear();
            for (int edges = 0; edges < 2; ++edges) mine.candidates[edges].count = mine.beside[edges].count = 0;
            if (!stray) list_beside(part, parts, mine);
            visit(part, [&](int64_t i, int64_t j) { look_at(i, j, first, mine, tally); });
        });
        int64_t looked_at = stray ? 0 : mesh.topology->num_beside, count = 0;
        for (int64_t part = 0; part < parts; ++part) looked_at += found[part].looked_at, count += found[part].count();
        overflowed = too_many(looked_at, count);
        if (overflowed) {
            found = {};  // gigabytes, perhaps
            return;
        }
        for (int64_t part = 0; part < parts; ++part) {
            crossed += found[part].crossed;
            released.insert(released.end(), found[part].released.begin(), found[part].released.end());
        }
        if (first) std::sort(released.begin(), released.end());
        for_parts(parts, [&](int64_t part) {
            for (int edges = 0; edges < 2; ++edges) {
                Found& mine = found[part];
                measure(edges, mine.candidates[edges], stray, mine.listed[edges]);
                measure(edges, mine.beside[edges], stray, mine.listed_beside[edges]);
            }
        });
        for (int edges = 0; edges < 2; ++edges) {
            const size_t before = pairs.size();
            found_at.clear();
            for (int64_t part = 0; part < parts; ++part) add(found[part].listed[edges]);
            const size_t apart = pairs.size();
            for (int64_t part = 0; part < parts; ++part) add(found[part].listed_beside[edges]);
            if (before < apart && apart < pairs.size()) merge(before, apart);
        }
    }

    bool too_many(int64_t looked_at, int64_t count) const { return looked_at > MOST_LOOKS * mesh.num_faces || count > MOST_PAIRS; }

    // Takes up the pairs of features of two faces whose boxes overlap.
    void look_at(int64_t i, int64_t j, bool first, Found& mine, Tally& tally) const {
        if (tally.over.load(std::memory_order_relaxed)) return;
        if (mine.looked_at && mine.looked_at % NOW_AND_THEN == 0) {
            const int64_t count = mine.count(), more = count - mine.told;
            mine.told = count;
            if (too_many(tally.looked_at += NOW_AND_THEN, tally.count += more)) tally.over = true;
        }
        const LayerTopology& topology = *mesh.topology;
        const OwnFeatures &vertices = topology.vertices, &edges = topology.edges;
        ++mine.looked_at;
        if (first && crossed_faces(mesh.order[i], mesh.order[j], from.data())) ++mine.crossed, release_faces(mesh.order[i], mesh.order[j], mine.released);
        mine.candidates[0].make_room(6), mine.candidates[1].make_room(9);
        for (int32_t v = vertices.starts[i]; v < vertices.starts[i + 1]; ++v) consider_vertex(v, j, i, j, mine.candidates[0]);
        for (int32_t v = vertices.starts[j]; v < vertices.starts[j + 1]; ++v) consider_vertex(v, i, i, j, mine.candidates[0]);
        for (int32_t a = edges.starts[i]; a < edges.starts[i + 1]; ++a)
            for (int32_t b = edges.starts[j]; b < edges.starts[j + 1]; ++b) consider_edges(a, b, i, j, mine.candidates[1]);
    }

    void add(const Listed& more) {
        pairs.insert(pairs.end(), more.pairs.begin(), more.pairs.end()), keys.insert(keys.end(), more.keys.begin(), more.keys.end());
        bounds.insert(bounds.end(), more.bounds.begin(), more.bounds.end()), found_at.insert(found_at.end(), more.found_at.begin(), more.found_at.end());
    }

    // Pairs of faces with a common vertex whose boxes overlap, of a part of what is known of them.
    void list_beside(int64_t part, int64_t parts, Found& mine) const {
        for (int edges = 0; edges < 2; ++edges) {
            const LayerTree& tree = memory->tree;
            const std::vector<MovingBox>&one = edges ? tree.own_edge : tree.own_vertex, &other = edges ? tree.own_edge : tree.face;
            const std::vector<Candidate>& known = mesh.topology->beside[edges];
            const std::vector<std::array<int32_t, 2>>& boxes = mesh.topology->boxes[edges];
            const Range some = range_of(known.size(), part, parts);
            if ((int64_t)mine.beside[edges].list.size() <= some.end - some.begin) mine.beside[edges].list.resize(some.end - some.begin + 1);
            for (int64_t i = some.begin; i < some.end; ++i) mine.beside[edges].offer(known[i], overlap(one[boxes[i][0]], other[boxes[i][1]]));
        }
    }

    // The pairs from ``apart`` on go among those from ``before`` on, in the order in which the tree visits their faces: that of sums.
    void merge(size_t before, size_t apart) {
        std::vector<std::pair<uint64_t, size_t>> order;
        for (size_t i = before; i < pairs.size(); ++i)
            order.push_back({rank_of(mesh.num_faces, found_at[i - before][0], found_at[i - before][1]), i});
        std::inplace_merge(order.begin(), order.begin() + (apart - before), order.end(), [](const auto& a, const auto& b) { return a.first < b.first; });
        const auto sorted = [&](auto& values) {
            auto moved = values;
            for (size_t i = before; i < values.size(); ++i) moved[i] = values[order[i - before].second];
            values.swap(moved);
        };
        sorted(pairs), sorted(keys), sorted(bounds);
    }

    const int32_t* corners_at(int64_t place) const { return mesh.faces + 3 * (int64_t)mesh.order[place]; }

    // Features by their places in the tree, of the faces i and j.
    void consider_vertex(int32_t place, int64_t at_face, int64_t i, int64_t j, Candidates& to) const {
        const int32_t v = mesh.topology->vertices.number[place];
        const bool near = overlap(memory->tree.own_vertex[place], memory->tree.face[at_face]) & !mesh.topology->holds(at_face, v);
        to.offer({v, mesh.order[at_face], {(int32_t)i, (int32_t)j}}, near);
    }

    void consider_edges(int32_t place, int32_t other, int64_t i, int64_t j, Candidates& to) const {
        const int32_t a = mesh.topology->edges.number[place], b = mesh.topology->edges.number[other];
        const bool near = overlap(memory->tree.own_edge[place], memory->tree.own_edge[other]) & !LayerTopology::meet(mesh, a, b);
        to.offer({std::min(a, b), std::max(a, b), {(int32_t)i, (int32_t)j}}, near);
    }

    void corners_of(int edges, Candidate pair, int32_t* corner) const {
        const int32_t* second = edges ? mesh.edges + 2 * (int64_t)pair.second : mesh.faces + 3 * (int64_t)pair.second;
        if (edges) std::copy(mesh.edges + 2 * (int64_t)pair.first, mesh.edges + 2 * (int64_t)pair.first + 2, corner);
        else corner[0] = pair.first;
        std::copy(second, second + (edges ? 2 : 3), corner + (edges ? 2 : 1));
    }

    // Those of the candidates that can come within their reach.
    void measure(int edges, const Candidates& given, const std::vector<uint8_t>* stray, Listed& into) const {
        into.pairs.clear(), into.keys.clear(), into.bounds.clear(), into.found_at.clear();
        for (size_t i = 0; i < given.count; i += AT_ONCE) measure(edges, given, i, stray, into);
    }

    // Of the next candidates: by the distance halfway, less what the features move towards each other from there and what they may
    // be off their ways.
    void measure(int edges, const Candidates& given, size_t begin, const std::vector<uint8_t>* stray, Listed& into) const {
        const std::vector<Candidate>& list = given.list;
        const int count = (int)std::min<size_t>(AT_ONCE, given.count - begin), split = edges ? 2 : 1;
        int32_t corner[AT_ONCE][4];
        for (int lane = 0; lane < AT_ONCE; ++lane) corners_of(edges, list[begin + std::min(lane, count - 1)], corner[lane]);
        const auto place = [&](const std::vector<double>& of, int c, int k) {
            return gather([&](int lane) { return of[4 * (int64_t)corner[lane][c] + k]; });
        };
        Lanes3 x[4], p[4];
        for (int c = 0; c < 4; ++c) {
            x[c] = {place(memory->middle, c, 0), place(memory->middle, c, 1), place(memory->middle, c, 2)};
            p[c] = {place(memory->half, c, 0), place(memory->half, c, 1), place(memory->half, c, 2)};
        }
        const VN square = edges ? segment_segment_sq(x) : point_triangle_sq(x);
        VN way[2] = {every(0.0), every(0.0)};
        if (moving) {
            const Lanes3 mean = {0.25 * (p[0].x + p[1].x + p[2].x + p[3].x), 0.25 * (p[0].y + p[1].y + p[2].y + p[3].y),
                                 0.25 * (p[0].z + p[1].z + p[2].z + p[3].z)};
            for (int c = 0; c < 4; ++c) {
                const Lanes3 own = p[c] - mean;
                way[c >= split] = more(way[c >= split], dot(own, own));
            }
        }
        const VN bounds = root(square) - (moving ? root(way[0]) + root(way[1]) : every(0.0)) - SLACK;
        const double most = most_reach + most_room + most_room;
        for (int lane = 0; lane < count; ++lane) {
            const double bound = bounds[lane];
            if (bound > most) continue;
            if ((stray && !any_of(corner[lane], 4, *stray)) || (between && mesh.piece[corner[lane][0]] == mesh.piece[corner[lane][3]])) continue;
            if (!whole && fixed[corner[lane][0]] && fixed[corner[lane][1]] && fixed[corner[lane][2]] && fixed[corner[lane][3]]) continue;
            double off[2] = {0.0, 0.0}, reach = mesh.reach[corner[lane][0]];
            for (int c = 0; c < 4; ++c) {
                off[c >= split] = std::max(off[c >= split], room[corner[lane][c]]);
                reach = std::min(reach, mesh.reach[corner[lane][c]]);
            }
            if (bound > reach + off[0] + off[1]) continue;
            // Vertices that were looked for alone are off the middle of their ways, at a time when the cloth has moved already.
            add(edges, list[begin + lane], corner[lane], reach, stray ? bound - off[0] - off[1] + moved : bound, into);
        }
    }

    void add(int edges, Candidate found, const int32_t* corner, double reach, double bound, Listed& into) const {
        const uint64_t k = key(edges, found.first, found.second);
        if (is_released(k)) return;
        LayerPair pair;
        std::copy(corner, corner + 4, pair.corner);
        pair.edges = edges, pair.reach = reach, pair.area = edges ? 0.0 : mesh.vertex_area[found.first], pair.parallel = 0.0;
        if (edges) {
            const int64_t a = found.first, b = found.second;
            pair.area = 0.5 * (mesh.edge_area[a] + mesh.edge_area[b]);
            pair.parallel = 1e-3 * mesh.edge_length_sq[a] * mesh.edge_length_sq[b];
        }
        into.pairs.push_back(pair), into.keys.push_back(k), into.bounds.push_back(bound);
        into.found_at.push_back({found.faces[0], found.faces[1]});
    }

    bool is_released(uint64_t k) const { return !released.empty() && std::binary_search(released.begin(), released.end(), k); }

    bool finite() const {
        double sum = 0.0;
        for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) sum += 0.0 * from[i] + 0.0 * to[i];
        return sum == 0.0;
    }

    // Takes all pairs out of the list but those that ``stays`` says.
    template <class Stays> void keep(const Stays& stays) {
        size_t kept = 0;
        for (size_t i = 0; i < pairs.size(); ++i)
            if (stays(i)) pairs[kept] = pairs[i], bounds[kept] = bounds[i], keys[kept++] = keys[i];
        pairs.resize(kept), bounds.resize(kept), keys.resize(kept);
    }

    // The first list of a step: what is crossed where it begins is left out.
    void begin() {
        if (begun) return;
        search(start.data(), ahead.data());
        if (!overflowed) return;
        overflowed = begun = false, crossed = 0, released.clear();
        search(start.data(), start.data());
    }

    // As if nothing had been asked yet.
    void restart() {
        begun = overflowed = known_apart = false, crossed = 0;
        released.clear(), pairs.clear(), keys.clear(), bounds.clear(), contacts.clear();
    }

    // Whether positions (V, 3) are where the step begins, where nothing is near anything: no list is needed for them.
    bool idle_at(const double* pos) const {
        return known_apart && !begun && std::memcmp(pos, start.data(), sizeof(double) * start.size()) == 0;
    }

    // Whether nothing is within its reach, or so much beyond it, at positions (V, 3).
    bool apart_at(const double* pos, double spare) {
        const LayerTimer timer(clock, LayerClock::LIMIT);
        cover(pos);
        if (overflowed || crossed || !released.empty()) return false;
        for (size_t i = 0; i < pairs.size(); ++i) {
            if (farther(i, most_reach + spare)) continue;
            Vec x[4];
            double weight[4];
            for (int c = 0; c < 4; ++c) x[c] = at(pos, pairs[i].corner[c]);
            const double dist = std::sqrt(pair_distance_sq(pairs[i].edges, x, weight));
            measured(i, dist);
            if (!(dist > pairs[i].reach + spare)) return false;
        }
        return true;
    }

    // Whether no two features meet on straight ways between positions (V, 3), nor are within their reach where those end: 2 where
    // nothing is so much beyond it there either. Where the answer is no, nothing else can be asked before a restart.
    int64_t free_way(const double* now, const double* end, double left, double spare) {
        const LayerTimer timer(clock, LayerClock::LIMIT);
        if (begun || !known_apart) {
            const bool free = limit(now, end, left) >= 1.0 && model(end) == 0;
            return free + (free && apart_at(end, spare));
        }
        // These ways alone count: no vertex is off them, and few pairs are listed.
        const std::vector<double> given = margin;
        margin.assign(given.size(), spare);
        search(now, end);
        margin = given;
        bool apart = !overflowed;
        for (const LayerPair& pair : pairs) {
            Vec x[4], p[4];
            for (int c = 0; c < 4; ++c) x[c] = at(now, pair.corner[c]), p[c] = at(end, pair.corner[c]) - x[c];
            double dist, weight[4];
            const double way = relative_way(pair.edges, p);
            if (safe_share(pair.edges, x, p, way, left, near_of(pair), &dist) < 1.0) return 0;
            for (int c = 0; c < 4; ++c) x[c] = at(end, pair.corner[c]);
            dist = std::sqrt(pair_distance_sq(pair.edges, x, weight));
            if (dist < pair.reach) return 0;
            apart &= dist > pair.reach + spare;
        }
        return 1 + apart;
    }

    // Distances do not change where all cloth is shifted: how far positions (V, 3) are off the ways on average, some share along.
    Vec shift_of(const double* pos, double share) const {
        Vec sum = {0.0, 0.0, 0.0};
        for (int64_t v = 0; v < mesh.num_vertices; ++v) sum = sum + off_way(pos, v, share);
        return (1.0 / (double)std::max<int64_t>(mesh.num_vertices, 1)) * sum;
    }

    Vec off_way(const double* pos, int64_t v, double share) const {
        const Vec begin = at(from.data(), v);
        return at(pos, v) - (begin + share * (at(to.data(), v) - begin));
    }

    bool astray(const double* pos, int64_t v, double share, Vec shift) const {
        const Vec off = off_way(pos, v, share) - shift;
        return !(dot(off, off) <= (room[v] + SLACK) * (room[v] + SLACK));
    }

    // Whether all vertices are within their margins, some share along.
    bool on_ways(const double* pos, double share) const {
        const Vec shift = shift_of(pos, share);
        bool off = false;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) off |= astray(pos, v, share, shift);
        return !off;
    }
    bool on_ways(const double* pos) const { return on_ways(pos, 1.0) || (moving && (on_ways(pos, 0.0) || on_ways(pos, share_of(pos)))); }

    // How far along the ways positions are.
    double share_of(const double* pos) const {
        double along = 0.0, size = 0.0;
        for (int64_t i = 0; i < 3 * mesh.num_vertices; ++i) {
            const double way = to[i] - from[i];
            along += way * (pos[i] - from[i]), size += way * way;
        }
        return size > 0.0 ? layer_clamp(along / size) : 0.0;
    }

    // Makes sure that the list holds at positions (V, 3), and on straight ways from there; bounds hold there.
    void cover(const double* pos) { cover(pos, pos); }
    void cover(const double* pos, const double* end) {
        if (!begun && known_apart && end != pos) search(pos, end);
        begin();
        if (overflowed) return;
        moved += 2.0 * farthest(last.data(), pos);
        last.assign(pos, pos + 3 * mesh.num_vertices);
        if (on_ways(pos) && (end == pos || on_ways(end))) return;
        const bool along = moving && end != pos;
        if (!(along && retrace(pos, end, true)) && !retrace(pos, end, false)) search(pos, end);
    }

    // Whether few vertices are astray, from the beginnings of the ways to their ends or at the ends; then their pairs are found.
    bool retrace(const double* pos, const double* end, bool along) {
        const double share = along ? 0.0 : 1.0;
        const Vec shifts[2] = {shift_of(pos, share), shift_of(end, 1.0)};
        strays.clear();
        for (int64_t v = 0; v < mesh.num_vertices; ++v)
            if (astray(pos, v, share, shifts[0]) || astray(end, v, 1.0, shifts[1])) strays.push_back((int32_t)v);
        if (strays.size() * FEW > (size_t)mesh.num_vertices) return false;
        search_again(pos, end, shifts, along);
        return true;
    }

    // Farthest that a vertex moves from positions to others, seen from their mean: distances change by twice that at most.
    double farthest(const double* a, const double* b) const {
        Vec mean = {0.0, 0.0, 0.0};
        for (int64_t v = 0; v < mesh.num_vertices; ++v) mean = mean + (at(b, v) - at(a, v));
        mean = (1.0 / (double)std::max<int64_t>(mesh.num_vertices, 1)) * mean;
        double square = 0.0;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) {
            const Vec own = at(b, v) - at(a, v) - mean;
            square = std::max(square, dot(own, own));
        }
        return std::sqrt(square);
    }

    // Whether a pair cannot be nearer than a distance where the cloth is.
    bool farther(size_t i, double dist) const { return bounds[i] - moved > dist; }
    void measured(size_t i, double dist) { bounds[i] = dist + moved - SLACK; }

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
        bool shared = false;
        for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) shared |= a[i] == b[j];
        if (shared) return false;
        if (between && mesh.piece[a[0]] == mesh.piece[b[0]]) return false;
        Vec x[3], y[3];
        for (int c = 0; c < 3; ++c) x[c] = at(pos, a[c]), y[c] = at(pos, b[c]);
        if (one_side(x, y) || one_side(y, x)) return false;
        bool crossed = false;
        for (int c = 0; c < 3; ++c) crossed |= pierces(x[c], x[(c + 1) % 3], y) || pierces(y[c], y[(c + 1) % 3], x);
        return crossed;
    }

    // Whether a triangle is on one side of another one's plane, as ``pierces`` sees it.
    static bool one_side(const Vec* x, const Vec* t) {
        const Vec normal = cross(t[1] - t[0], t[2] - t[0]);
        const bool above = dot(x[0] - t[0], normal) > 0.0;
        return (dot(x[1] - t[0], normal) > 0.0) == above && (dot(x[2] - t[0], normal) > 0.0) == above;
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

    void release_faces(int64_t f, int64_t g, std::vector<uint64_t>& to) const {
        const int32_t *a = mesh.faces + 3 * f, *b = mesh.faces + 3 * g;
        for (int c = 0; c < 3; ++c) {
            to.push_back(key(0, a[c], g));
            to.push_back(key(0, b[c], f));
            for (int d = 0; d < 3; ++d) {
                const int64_t one = edge_number(a[c], a[(c + 1) % 3]), two = edge_number(b[d], b[(d + 1) % 3]);
                to.push_back(key(1, std::min(one, two), std::max(one, two)));
            }
        }
    }

    // ---- the way -------------------------------------------------------------------------------------------------------

    // Share of the straight ways between positions (V, 3) that no two features meet on, and the pairs that would.
    double limit(const double* now, const double* end, double left, std::vector<int32_t>* meeting = nullptr, std::vector<double>* shares = nullptr) {
        const LayerTimer timer(clock, LayerClock::LIMIT);
        cover(now, end);
        const double far = 2.0 * farthest(now, end) / (1.0 - left);
        double least = 1.0;
        for (size_t i = 0; i < pairs.size(); ++i) {
            if (farther(i, far)) continue;
            const LayerPair& pair = pairs[i];
            Vec x[4], p[4];
            for (int c = 0; c < 4; ++c) x[c] = at(now, pair.corner[c]), p[c] = at(end, pair.corner[c]) - x[c];
            const double way = relative_way(pair.edges, p);
            if (farther(i, way / (1.0 - left))) continue;
            double dist;
            const double share = safe_share(pair.edges, x, p, way, left, near_of(pair), &dist);
            measured(i, dist);
            if (share >= 1.0) continue;
            least = std::min(least, share);
            if (meeting) meeting->push_back((int32_t)i), shares->push_back(share);
        }
        return least;
    }

    // Distance below which a pair may hardly come nearer.
    double near_of(const LayerPair& pair) const { return (!careful.empty() && any_of(pair.corner, 4, careful) ? PINCHED : NARROW) * pair.reach; }

    // Moves targets (V, 3) of free vertices so that the straight ways there from positions (V, 3) are free, as little as it can:
    // first the corners of pairs that meet go on together, then from the last resort, if there is one, else all vertices. Pairs that
    // held vertices drive through each other are left out from then on. Returns how many.
    int64_t approach(double* to, double left) {
        const LayerTimer timer(clock, LayerClock::LIMIT);
        const double* from = start.data();
        const std::vector<double> target(to, to + start.size());
        int64_t forced = 0;
        if (!go_together(from, to, left, 29) && !approach_from_resort(target, to, left)) forced = approach_as_one(from, to, left);
        std::sort(released.begin(), released.end());
        if (forced) keep([&](size_t i) { return !is_released(keys[i]); });
        return forced;
    }

    bool approach_from_resort(const std::vector<double>& target, double* to, double left) {
        if (resort.empty()) return false;
        std::copy(target.begin(), target.end(), to);
        const double share = ease(resort.data(), to, left);
        for (size_t i = 0; i < target.size() && share < 1.0; ++i) to[i] = resort[i] + share * (to[i] - resort[i]);
        return true;
    }

    // The same without a last resort, for a way that begins anywhere: what is left of it. Where pairs go on meeting, all that hangs
    // together by them keeps its common motion, and loses the same share of the rest.
    double ease(const double* from, double* to, double left) {
        const LayerTimer timer(clock, LayerClock::LIMIT);
        if (go_together(from, to, left, PAIR_ROUNDS)) return 1.0;
        std::vector<int32_t> zone(mesh.num_vertices), meeting;
        for (int64_t v = 0; v < mesh.num_vertices; ++v) zone[v] = (int32_t)v;
        std::vector<double> shares;
        for (int round = 0;; ++round) {
            meeting.clear(), shares.clear();
            const double share = limit(from, to, left, &meeting, &shares);
            if (share >= 1.0 || round == ZONE_ROUNDS) return share;
            slow_zones(meeting, shares, zone, from, to);
        }
    }

    // Whether fixed vertices that go from ``along`` to ``there`` (V, 3) meet nothing, ``along`` being where all begin, moved as one
    // body. They go no farther than pairs that are not in the list are apart where the step begins.
    bool fixed_are_free(const double* along, const double* there, double farthest, double left) {
        const LayerTimer timer(clock, LayerClock::LIMIT);
        begin();
        if (overflowed) return true;
        for (size_t i = 0; i < pairs.size(); ++i) {
            const LayerPair& pair = pairs[i];
            if (farther(i, 2.0 * farthest / (1.0 - left)) || !any_of(pair.corner, 4, fixed)) continue;
            Vec x[4], p[4];
            for (int c = 0; c < 4; ++c) x[c] = at(along, pair.corner[c]), p[c] = at(there, pair.corner[c]) - x[c];
            double dist;
            const double way = relative_way(pair.edges, p);
            if (safe_share(pair.edges, x, p, way, left, near_of(pair), &dist) < 1.0) return false;
        }
        return true;
    }

    static constexpr int PAIR_ROUNDS = 8, ZONE_ROUNDS = 12;

    // Rounds in which corners of pairs that would meet go on together; whether none meets in the end.
    bool go_together(const double* from, double* to, double left, int rounds) {
        std::vector<double> shift, count, shares;
        std::vector<int32_t> meeting;
        for (int round = 0;; ++round) {
            meeting.clear(), shares.clear();
            if (limit(from, to, left, &meeting, &shares) >= 1.0) return true;
            if (round == rounds) return false;
            bring_together(meeting, shares, from, to, shift, count);
        }
    }

    // Targets of free corners of pairs that meet, by the means of what their pairs ask; the last two are room for that.
    void bring_together(const std::vector<int32_t>& meeting, const std::vector<double>& shares, const double* from, double* to, std::vector<double>& shift,
                        std::vector<double>& count) const {
        shift.assign(3 * mesh.num_vertices, 0.0), count.assign(mesh.num_vertices, 0.0);
        for (size_t i = 0; i < meeting.size(); ++i) bring_together(pairs[meeting[i]], 0.5 * shares[i], from, to, shift.data(), count.data());
        for (int64_t v = 0; v < mesh.num_vertices; ++v)
            for (int k = 0; k < 3 && count[v] > 0.0; ++k) to[3 * v + k] += shift[3 * v + k] / count[v];
    }

    static int32_t zone_of(std::vector<int32_t>& zone, int32_t v) {
        while (zone[v] != v) v = zone[v] = zone[zone[v]];
        return v;
    }

    void slow_zones(const std::vector<int32_t>& meeting, const std::vector<double>& shares, std::vector<int32_t>& zone, const double* from, double* to) const {
        std::vector<double> least(mesh.num_vertices, 1.0), sum(5 * mesh.num_vertices, 0.0);
        for (int32_t i : meeting)
            for (int c = 1; c < 4; ++c) zone[zone_of(zone, pairs[i].corner[c])] = zone_of(zone, pairs[i].corner[0]);
        for (size_t i = 0; i < meeting.size(); ++i) {
            double& share = least[zone_of(zone, pairs[meeting[i]].corner[0])];
            share = std::min(share, 0.6 * shares[i]);
        }
        for (int64_t v = 0; v < mesh.num_vertices; ++v) {  // the motion of a zone is that of what is held in it, if anything is
            const int32_t z = zone_of(zone, (int32_t)v);
            double* of = sum.data() + 5 * z;
            if (least[z] >= 1.0 || (of[4] > 0.0 && !fixed[v])) continue;
            if (fixed[v] && of[4] == 0.0) of[0] = of[1] = of[2] = of[3] = 0.0, of[4] = 1.0;
            for (int k = 0; k < 3; ++k) of[k] += to[3 * v + k] - from[3 * v + k];
            of[3] += 1.0;
        }
        for (int64_t v = 0; v < mesh.num_vertices; ++v) {
            const int32_t z = zone_of(zone, (int32_t)v);
            if (least[z] >= 1.0 || fixed[v]) continue;
            const double* of = sum.data() + 5 * z;
            for (int k = 0; k < 3; ++k) {
                const double common = of[k] / of[3], own = to[3 * v + k] - from[3 * v + k];
                to[3 * v + k] = from[3 * v + k] + common + least[z] * (own - common);
            }
        }
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
        return (int64_t)meeting.size();
    }

    // ---- the barrier ---------------------------------------------------------------------------------------------------

    // Whether a pair is within its reach at positions that are covered.
    bool contact(size_t i, const double* pos, LayerContact& found, Vec* x) {
        if (farther(i, most_reach)) return false;
        const LayerPair& pair = pairs[i];
        for (int c = 0; c < 4; ++c) x[c] = at(pos, pair.corner[c]);
        const double dist = std::sqrt(pair_distance_sq(pair.edges, x, found.weight));
        measured(i, dist);
        if (!(dist < pair.reach)) return false;
        // Features that touch are told from those that nearly do no more: the barrier stays finite.
        found.pair = (int32_t)i, found.dist = std::max(dist, 1e-12);
        Vec gap = {0.0, 0.0, 0.0};
        for (int c = 0; c < 4; ++c) gap = gap + found.weight[c] * x[c];
        found.gap[0] = gap.x, found.gap[1] = gap.y, found.gap[2] = gap.z;
        return true;
    }

    double energy(const double* pos) {
        const LayerTimer timer(clock, LayerClock::ENERGY);
        cover(pos);
        double sum = 0.0, slope;
        for (size_t i = 0; i < pairs.size(); ++i) {
            LayerContact found;
            Vec x[4];
            if (!contact(i, pos, found, x)) continue;
            const LayerPair& pair = pairs[i];
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
        const LayerTimer timer(clock, LayerClock::MODEL);
        const bool idle = idle_at(pos);
        if (!idle) cover(pos);
        contacts.clear(), rows.clear(), normals.clear(), normals_single.clear();
        gradient.assign(3 * mesh.num_vertices, 0.0), own.assign(6 * mesh.num_vertices, 0.0);
        for (size_t i = 0; i < pairs.size() && !idle; ++i) {
            LayerContact found;
            Vec x[4];
            if (!contact(i, pos, found, x)) continue;
            contacts.push_back(found);
            add_model(pairs[i], found, x);
        }
        show();
        return (int64_t)contacts.size();
    }

    void show() {
        here.resize(3 * mesh.num_vertices), there.resize(3 * mesh.num_vertices);
        view.layers = this, view.here = here.data(), view.there = there.data();
        view.num_contacts = (int64_t)contacts.size(), view.rows = rows.data();
        view.normals = normals.data(), view.normals_single = normals_single.data();
        view.gradient = gradient.data(), view.own = own.data();
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
            double n[4] = {};
            for (int k = 0; k < 3; ++k) {
                gradient[3 * v + k] += push * found.weight[c] * found.gap[k];
                n[k] = stiff * found.weight[c] * found.gap[k];
            }
            double* upper = own.data() + 6 * v;
            upper[0] += n[0] * n[0], upper[1] += n[0] * n[1], upper[2] += n[0] * n[2];
            upper[3] += n[1] * n[1], upper[4] += n[1] * n[2], upper[5] += n[2] * n[2];
            if (fade > 0.0) {
                const Vec turn = c < 2 ? by_first : by_second;
                const double sign = c % 2 ? 1.0 : -1.0;
                gradient[3 * v] += sign * turn.x, gradient[3 * v + 1] += sign * turn.y, gradient[3 * v + 2] += sign * turn.z;
            }
            add_row(v, n);
        }
    }

    void add_row(int64_t v, const double* n) {
        const bool moves = row.empty() || row[v] < num_rows;
        rows.push_back(row.empty() ? (int32_t)v : moves ? row[v] : 0);
        for (int k = 0; k < 4; ++k) {
            const double value = moves ? n[k] : 0.0;
            normals.push_back(value), normals_single.push_back((float)value);
        }
    }
};

}  // namespace
