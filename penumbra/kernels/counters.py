"""Places of the counters that casting kernels add to: one int64 array of N_COUNTERS per task."""

NAMES = (
    "blockers_tested",  # blockers that entered a receiver hierarchy
    "blockers_culled",  # blockers outside the shaft between a tile and the light
    "nodes_visited",  # receiver nodes tested against a penumbra volume
    "plane_box_tests",  # box against plane of a penumbra volume
    "plane_point_tests",  # receiver against plane of a penumbra volume
    "light_volumes_built",  # penumbra volumes of the whole light
    "group_volumes_built",  # penumbra volumes of light sample groups
    "umbra_nodes_skipped",  # nodes left because all is blocked below
    "umbra_receivers_skipped",  # receivers left because all is blocked
    "umbra_groups_skipped",  # light sample groups left because they are blocked
    "pairs_tested",  # receiver x blocker pairs that reached the hard shadow volumes
    "samples_tested",  # receiver x blocker x sample triples decided, of samples not blocked before
    "escalated_f64",  # of those, left open by float32 lanes, or by the volume of a point light
    "escalated_exact",  # predicates decided in exact integers
    "pairs_assigned",  # receiver x blocker pairs that share a cell of the grid (gears)
    "pairs_blocking",  # pairs whose blocker blocks at least one sample (gears)
    "pairs_covering",  # of those, pairs whose blocker was seen to block all samples at once (gears)
    "masks_allocated",  # masks taken from the pool
    "masks_released",  # masks given back because all is blocked
    "leaves_visited",  # leaf of receivers x chunk x block of samples that the joint descent entered
    "tree_nodes_visited",  # leaf of receivers x node of a chunk's hierarchy
    "clusters_visited",  # leaf of receivers x cluster of 16 blockers
    "cluster_tests",  # receiver x cluster pairs whose samples were looked up
    "cluster_pairs",  # receiver x cluster pairs set up
    "triangle_major",  # of those, tested one blocker against 16 samples at a time
    "pairs_escalated",  # receiver x blocker pairs decided in world space
    "lanes_tested",  # receiver x blocker x sample lanes of the joint descent
)
(
    BLOCKERS_TESTED,
    BLOCKERS_CULLED,
    NODES_VISITED,
    PLANE_BOX_TESTS,
    PLANE_POINT_TESTS,
    LIGHT_VOLUMES_BUILT,
    GROUP_VOLUMES_BUILT,
    UMBRA_NODES_SKIPPED,
    UMBRA_RECEIVERS_SKIPPED,
    UMBRA_GROUPS_SKIPPED,
    PAIRS_TESTED,
    SAMPLES_TESTED,
    ESCALATED_F64,
    ESCALATED_EXACT,
    PAIRS_ASSIGNED,
    PAIRS_BLOCKING,
    PAIRS_COVERING,
    MASKS_ALLOCATED,
    MASKS_RELEASED,
    LEAVES_VISITED,
    TREE_NODES_VISITED,
    CLUSTERS_VISITED,
    CLUSTER_TESTS,
    CLUSTER_PAIRS,
    TRIANGLE_MAJOR,
    PAIRS_ESCALATED,
    LANES_TESTED,
) = range(len(NAMES))
N_COUNTERS = len(NAMES)
