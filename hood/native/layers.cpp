// Cloth near cloth, as Python asks for it; see layers.h and hood/mesh/cloth_proximity.py. Positions are (V, 3) float64 [m].
#include "layers.h"
#include "layer_pins.h"
#include "layer_pressing.h"

extern "C" {

// Layers of a step from positions on, which may end ``ahead``; ``margins`` (V) [m] is how far vertices may be off straight ways;
// ``apart`` says that nothing is near or through anything there.
void* layers_make(const void* mesh, const double* pos, const double* ahead, const uint8_t* fixed, const double* margins, double pressure, int64_t between,
                  int64_t apart, int64_t threads) {
    Layers* layers = new Layers;
    layers->mesh = *(const LayerMesh*)mesh;
    layers->fixed.assign(fixed, fixed + layers->mesh.num_vertices);
    layers->start.assign(pos, pos + 3 * layers->mesh.num_vertices);
    layers->ahead.assign(ahead, ahead + 3 * layers->mesh.num_vertices);
    layers->margin.assign(margins, margins + layers->mesh.num_vertices);
    layers->pressure = pressure, layers->between = between != 0, layers->known_apart = apart != 0, layers->threads = threads;
    return layers;
}

void layers_free(void* layers) { delete (Layers*)layers; }

// What searches know of the faces of a mesh, which its ``topology`` has to point to.
void* layers_topology(const void* mesh) { return new LayerTopology(*(const LayerMesh*)mesh); }

void layers_topology_free(void* topology) { delete (LayerTopology*)topology; }

// Pairs of faces that pass through each other where the step begins.
int64_t layers_crossed(void* handle) {
    Layers* layers = (Layers*)handle;
    if (!layers->known_apart) layers->begin();
    return layers->crossed;
}

// Forgets what has been asked so far.
void layers_restart(void* handle) { ((Layers*)handle)->restart(); }

// Whether nothing is within its reach and so much beyond it [m] at positions.
int64_t layers_apart(void* handle, const double* pos, double spare) { return ((Layers*)handle)->apart_at(pos, spare); }

// Whether ways are free, and what is at their ends apart: see Layers.
int64_t layers_free_way(void* handle, const double* now, const double* end, double left, double spare) {
    return ((Layers*)handle)->free_way(now, end, left, spare);
}

// Targets that can be reached become ``to``; returns how many pairs are left out for it.
int64_t layers_approach(void* handle, double* to, double left) {
    return ((Layers*)handle)->approach(to, left);
}

// Where ways lead that are known to be free: what is left where nearer targets cannot be reached.
void layers_resort(void* handle, const double* pos) {
    Layers* layers = (Layers*)handle;
    layers->resort.assign(pos, pos + layers->start.size());
}

// Whether fixed vertices meet nothing on their ways, from where all vertices are moved as one body.
int64_t layers_fixed_are_free(void* handle, const double* along, const double* there, double farthest, double left) {
    return ((Layers*)handle)->fixed_are_free(along, there, farthest, left);
}

// Positions ``to`` that straight ways lead to; 1 where fixed vertices are at their targets there. Of layers for this alone.
int64_t layers_follow(void* handle, const double* target, double left, double* to) {
    Layers* layers = (Layers*)handle;
    layers->whole = true, layers->known_apart = false;
    return LayerPins{*layers, target}.follow(left, to);
}

double layers_limit(void* handle, const double* from, const double* to, double left) { return ((Layers*)handle)->limit(from, to, left); }

// Targets ``to`` become such that straight ways there are free: bent where features would meet, then shortened if they still would.
void layers_ease(void* handle, const double* from, double* to, double left) {
    Layers* layers = (Layers*)handle;
    const double share = layers->ease(from, to, left);
    for (int64_t i = 0; i < 3 * layers->mesh.num_vertices && share < 1.0; ++i) to[i] = from[i] + share * (to[i] - from[i]);
}

double layers_energy(void* handle, const double* pos) { return ((Layers*)handle)->energy(pos); }

// What presses pairs onto each other in a step [N] (N).
void layers_pressing(const LayerPressing* step, double* pressing) { layer_pressing(*step, pressing); }

// Contacts at positions; returns how many.
int64_t layers_model(void* handle, const double* pos) { return ((Layers*)handle)->model(pos); }

// Those of the last model: corners (N, 4), two edges or not (N), weights of the corners in the gap (N, 4), then reach [m],
// area [m^2] and bound of parallel edges [m^4], (N, 3).
void layers_contacts(const void* handle, int64_t* corners, int64_t* edges, double* weights, double* constants) {
    const Layers* layers = (const Layers*)handle;
    for (size_t i = 0; i < layers->contacts.size(); ++i) {
        const LayerContact& contact = layers->contacts[i];
        const LayerPair& pair = layers->pairs[contact.pair];
        for (int c = 0; c < 4; ++c) corners[4 * i + c] = pair.corner[c], weights[4 * i + c] = contact.weight[c];
        edges[i] = pair.edges;
        constants[3 * i] = pair.reach, constants[3 * i + 1] = pair.area, constants[3 * i + 2] = pair.parallel;
    }
}

// Numbers (V) by which rows name vertices from now on; those from ``num_rows`` on do not move. Returns what solvers read.
const void* layers_number(void* handle, const int32_t* row, int64_t num_rows) {
    Layers* layers = (Layers*)handle;
    layers->row.assign(row, row + layers->mesh.num_vertices);
    layers->num_rows = (int32_t)num_rows;
    layers->show();
    layers->view.limit = layers_limit, layers->view.ease = layers_ease, layers->view.energy = layers_energy, layers->view.model = layers_model;
    return &layers->view;
}

// Gradient (V, 3) [N] and the upper triangles (V, 6) of the diagonal blocks of the last model's curvature.
void layers_forces(const void* handle, double* gradient, double* own) {
    const Layers* layers = (const Layers*)handle;
    std::copy(layers->gradient.begin(), layers->gradient.end(), gradient);
    std::copy(layers->own.begin(), layers->own.end(), own);
}

// Rows (N, 12) whose outer products are the curvature of the last model.
void layers_rows(const void* handle, double* normals) {
    const std::vector<double>& own = ((const Layers*)handle)->normals;
    for (size_t i = 0; i < own.size() / 4; ++i) std::copy(&own[4 * i], &own[4 * i] + 3, normals + 3 * i);
}

// Pairs of features in the list, pairs that are left out, searches so far, those for some vertices alone, whether there were too
// many pairs for a list; seconds (4) of processor time: of searching, of limiting moves, of energies and of models.
void layers_counts(const void* handle, int64_t* counts, double* seconds) {
    const Layers* layers = (const Layers*)handle;
    counts[0] = (int64_t)layers->pairs.size(), counts[1] = (int64_t)layers->released.size(), counts[2] = layers->searches;
    counts[3] = layers->refreshes, counts[4] = layers->overflowed;
    for (int part = LayerClock::SEARCH; part < LayerClock::PARTS; ++part) seconds[part - 1] = layers->clock.seconds[part];
}
}
