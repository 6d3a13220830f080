/* How long each of several thrusters pushes, so that together they make a force and a torque in the plane.
 *
 * The duty u_i of thruster i is the share of time in which it pushes, 0 to 1. Of all duties that make what is wanted,
 * the least Σ u_i is taken: a linear programme with bounds on both sides,
 *
 *   least Σ u_i with Σ u_i·a_i = s·wanted and 0 ≤ u_i ≤ 1, where s = 1, or the greatest s below for which there are
 * such u
 *
 * What thrusters can make is a zonotope. The optimum of such a programme has three duties between the bounds, a basis,
 * and all others at one of them. At which ones does not depend on what is wanted: thruster j is at 1 where it costs
 * less than the basis that would replace it. So each basis is optimal in one parallelepiped, and these tile the
 * zonotope. Costs that are equal are told apart by an infinitesimal that is smaller from thruster to thruster, so that
 * the tiles neither overlap nor leave gaps, and duties are a continuous function of what is wanted. The greatest s is
 * where the ray to `wanted` leaves through a facet; each facet is spanned by two thrusters.
 *
 * Tiles and facets are computed once. To allocate is then a pass over all facets, at most 120, and one over all tiles,
 * at most 560: no iteration, and the same time for every command.
 */
#ifndef FLOTILLA_ALLOCATION_H
#define FLOTILLA_ALLOCATION_H

#include <stdbool.h>
#include <stdint.h>

enum {
    ALLOCATION_AXES = 3, /* force in x and y in N, torque in N·m */
    ALLOCATION_MOST = 16,
    ALLOCATION_FACETS = ALLOCATION_MOST * (ALLOCATION_MOST - 1) / 2,
    ALLOCATION_TILES = ALLOCATION_FACETS * (ALLOCATION_MOST - 2) / 3,
};

/* Two opposite facets: those farthest along the normal, and against it. */
struct allocation_facets {
    double normal[ALLOCATION_AXES];
    double along, against; /* how far normal·(Σ u_i·a_i) can be */
};

struct allocation_tile {
    uint32_t thruster[ALLOCATION_AXES];
    uint32_t full;                                    /* bit j: thruster j is at 1 */
    double inverse[ALLOCATION_AXES][ALLOCATION_AXES]; /* of the matrix of these thrusters */
    double offset[ALLOCATION_AXES];                   /* inverse·(what the full ones make) */
};

struct allocation {
    uint32_t count;
    double column[ALLOCATION_MOST][ALLOCATION_AXES]; /* force and torque of each thruster that pushes all the time */
    uint32_t facet_count, tile_count;
    struct allocation_facets facets[ALLOCATION_FACETS];
    struct allocation_tile tiles[ALLOCATION_TILES];
};

/* Compute facets and tiles; `count` and `column` are given. */
void allocation_prepare(struct allocation *allocation);

/* Whether something in this direction alone can be made. */
bool allocation_makes(const struct allocation *allocation, const double direction[ALLOCATION_AXES]);

/* The duties of all thrusters, `count` of them, and s as above. What is wanted is finite and below 1e30. */
double allocate(const struct allocation *allocation, const double wanted[ALLOCATION_AXES],
                double duty[ALLOCATION_MOST]);

#endif
