//! From an enclosed void to a rough path through it: portals, the main tunnel between the two farthest ends, branches.
//!
//! Level sets of the geodesic distance inside the void are cut into connected pieces; pieces and their contacts make a
//! graph (a discrete Reeb graph) whose tree is the tunnel with its side drifts, and whose cycles are loops.
//! Reference: A. Verroust, F. Lazarus, "Extracting skeletal curves from 3D scattered data", The Visual Computer 16(1),
//! 2000, doi:10.1007/PL00007210 (there on the points, here on the void, which also works for one-sided walls).
//!
//! Distances are measured from a whole portal, not from a cell, so that level sets are parallel to it and short wide
//! pieces work too. Cost: three Dijkstra passes over the cells of the void.

use super::enclosed_void::{EnclosedVoid, State};
use crate::numeric::Vec3;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BinaryHeap};

/// A void's contact with the outside is a portal when it is at least this share of the mean section.
const PORTAL_SHARE: f64 = 0.3;
/// A portal has at most this many times the cells of the mean section.
const LARGEST_PORTAL: f64 = 2.0;
/// A dead end counts as the tunnel's end, instead of the farthest portal, when it is this much farther.
const DEAD_END_PREFERENCE: f64 = 1.5;
/// Shorter side spaces than this many clearances are niches.
const BRANCH_CLEARANCES: f64 = 2.0;
/// Both arms of a cycle longer than this many clearances make a loop; shorter ones go around a pillar or a vehicle.
const LOOP_CLEARANCES: f64 = 4.0;

/// A side drift of the main path.
pub(super) struct RoughBranch {
    /// Where it leaves the void of the main path.
    pub mouth: Vec3,
    /// Mean of its own cells.
    pub middle: Vec3,
    /// From the mouth to its far end, metres.
    pub length_m: f64,
}

/// The rough path and what hangs on it.
pub(super) struct Skeleton {
    /// Means of the level sets from end to end.
    pub path: Vec<Vec3>,
    /// Cells of the void on the main path, ascending.
    pub main_cells: Vec<usize>,
    pub branches: Vec<RoughBranch>,
    /// Whether the path ends at a portal, at its start and its end.
    pub ends_at_portal: [bool; 2],
    /// Cells of the void at its start and its end, by their rank: a portal's, or one at the bottom of a dead end.
    ends: [Vec<usize>; 2],
    /// Length of the shorter arm of the longest cycle, metres, if it is a loop and not just a pillar.
    pub loop_arm_m: Option<f64>,
    /// Cycles too short to be loops.
    pub pillars: usize,
}

/// Distances in the void, in metres, from a set of its cells (given by their rank in `cells`).
fn distances(void: &EnclosedVoid, sources: &[usize]) -> Vec<f64> {
    cheapest(void, sources, |step, _, _| step).0
}

/// Least cost of a way from the `sources` to each cell, by rank, and the cell before it; `cost` of a step of some metres
/// from one cell to another.
fn cheapest(
    void: &EnclosedVoid,
    sources: &[usize],
    cost: impl Fn(f64, usize, usize) -> f64,
) -> (Vec<f64>, Vec<Option<usize>>) {
    let mut least = vec![f64::INFINITY; void.cells.len()];
    let mut from = vec![None; void.cells.len()];
    // Non-negative floats order as their bits.
    let mut queue: BinaryHeap<Reverse<(u64, usize)>> = BinaryHeap::new();
    for &s in sources {
        least[s] = 0.0;
        queue.push(Reverse((0, s)));
    }
    while let Some(Reverse((bits, i))) = queue.pop() {
        let here = f64::from_bits(bits);
        if here > least[i] {
            continue;
        }
        for (n, step) in void.grid.neighbours(void.cells[i], 26) {
            let Ok(j) = void.cells.binary_search(&n) else { continue };
            let through = here + cost(step * void.grid.cell_m, i, j);
            if through < least[j] {
                least[j] = through;
                from[j] = Some(i);
                queue.push(Reverse((through.to_bits(), j)));
            }
        }
    }
    (least, from)
}

/// Connected groups (26 neighbours) of the given ranks, each ascending, in order of their first rank.
fn groups(void: &EnclosedVoid, ranks: &[usize]) -> Vec<Vec<usize>> {
    let mut left: BTreeMap<usize, bool> = ranks.iter().map(|&r| (r, false)).collect();
    let mut found = Vec::new();
    for &start in ranks {
        if left[&start] {
            continue;
        }
        left.insert(start, true);
        let mut group = vec![start];
        let mut done = 0;
        while done < group.len() {
            let cell = void.cells[group[done]];
            done += 1;
            for (n, _) in void.grid.neighbours(cell, 26) {
                if let Ok(rank) = void.cells.binary_search(&n)
                    && let Some(taken) = left.get_mut(&rank)
                    && !*taken
                {
                    *taken = true;
                    group.push(rank);
                }
            }
        }
        group.sort_unstable();
        found.push(group);
    }
    found
}

fn farthest(distance: &[f64], among: impl Iterator<Item = usize>) -> usize {
    among.max_by(|&a, &b| distance[a].total_cmp(&distance[b]).then(b.cmp(&a))).unwrap_or(0)
}

fn mean_distance(distance: &[f64], group: &[usize]) -> f64 {
    group.iter().map(|&r| distance[r]).sum::<f64>() / group.len() as f64
}

/// The end of the tunnel farthest from where `distance` is measured: a portal, or a dead end if that is much farther.
/// `section_cells` is the number of cells of a usual section.
fn far_end(
    distance: &[f64],
    portals: &[Vec<usize>],
    section_cells: f64,
    from: Option<usize>,
) -> (Vec<usize>, Option<usize>) {
    let dead_end = farthest(distance, 0..distance.len());
    let portal = (0..portals.len())
        .filter(|&p| Some(p) != from)
        .max_by(|&a, &b| mean_distance(distance, &portals[a]).total_cmp(&mean_distance(distance, &portals[b])));
    // The far corner of a wide portal is no dead end; walls full of gaps are no portal.
    let reach = |p: usize| match &portals[p] {
        portal if portal.len() as f64 <= LARGEST_PORTAL * section_cells => {
            portal.iter().map(|&r| distance[r]).fold(0.0, f64::max)
        }
        portal => mean_distance(distance, portal),
    };
    match portal {
        Some(p) if reach(p) * DEAD_END_PREFERENCE >= distance[dead_end] => (portals[p].clone(), Some(p)),
        _ => (vec![dead_end], None),
    }
}

/// Finds the main path through a void: between its two farthest ends, or between the cells nearest to `ends`.
pub(super) fn skeleton(void: &EnclosedVoid, ends: Option<[Vec3; 2]>) -> Skeleton {
    let grid = &void.grid;
    let open: Vec<usize> = (0..void.cells.len())
        .filter(|&i| grid.neighbours(void.cells[i], 6).any(|(n, _)| grid.state(n) == State::Empty))
        .collect();
    let first = distances(void, &[farthest(&distances(void, &[0]), 0..void.cells.len())]);
    let longest = first[farthest(&first, 0..first.len())].max(grid.cell_m);
    let section_cells = void.cells.len() as f64 * grid.cell_m / longest;
    let portals: Vec<Vec<usize>> =
        groups(void, &open).into_iter().filter(|g| g.len() as f64 >= PORTAL_SHARE * section_cells).collect();

    let nearest_rank = |p: &Vec3| {
        let gap = |i: &usize| (grid.centre(void.cells[*i]) - p).norm();
        (0..void.cells.len()).min_by(|a, b| gap(a).total_cmp(&gap(b))).expect("a void has cells")
    };
    let (start, start_portal, target, target_portal) = if let Some([a, b]) = ends {
        let holding = |rank: usize| portals.iter().position(|p| p.contains(&rank));
        let (a, b) = (nearest_rank(&a), nearest_rank(&b));
        let group = |rank: usize| holding(rank).map_or(vec![rank], |p| portals[p].clone());
        (group(a), holding(a), group(b), holding(b))
    } else {
        // From the largest portal to the end farthest from it, and from there back to the end farthest from that.
        let largest = (0..portals.len()).max_by_key(|&p| (portals[p].len(), Reverse(p)));
        let (seed, seed_portal) = match largest {
            Some(p) => (portals[p].clone(), Some(p)),
            None => (vec![farthest(&first, 0..first.len())], None),
        };
        let (one, one_portal) = far_end(&distances(void, &seed), &portals, section_cells, seed_portal);
        let (other, other_portal) = far_end(&distances(void, &one), &portals, section_cells, one_portal);
        (one, one_portal, other, other_portal)
    };

    let distance = distances(void, &start);
    let width = (2.0 * grid.cell_m).max(0.5 * void.clearance_m);
    let graph = level_sets(void, &distance, width);
    let target_rank = target[target.len() / 2];
    let main = graph.path_to(graph.piece_of[target_rank]);

    let mut main_cells: Vec<usize> =
        main.iter().flat_map(|&p| graph.pieces[p].iter().map(|&r| void.cells[r])).collect();
    main_cells.sort_unstable();
    let mean = |ranks: &[usize]| mean_of(void, ranks);
    let path = main.iter().map(|&p| mean(&graph.pieces[p])).collect();
    let (branches, loop_arm_m, pillars) = graph.side_spaces(&main, &distance, void, mean, width);
    Skeleton {
        path,
        main_cells,
        branches,
        ends_at_portal: [start_portal.is_some(), target_portal.is_some()],
        ends: [start, target],
        loop_arm_m,
        pillars,
    }
}

impl Skeleton {
    /// The middles of the portals that the path starts and ends at.
    pub fn portals(&self, void: &EnclosedVoid) -> Vec<Vec3> {
        let ends = self.ends.iter().zip(self.ends_at_portal).filter(|(_, portal)| *portal);
        ends.map(|(ranks, _)| mean_of(void, ranks)).collect()
    }

    /// Cells from end to end along the widest way: the least sum of steps over squared distances from the wall.
    pub fn widest_way(&self, void: &EnclosedVoid) -> Vec<Vec3> {
        let layers = void.layers();
        let width = |rank: usize| f64::from(layers[rank]).max(1.0);
        let (cost, from) =
            cheapest(void, &self.ends[0], |step, a, b| step * 2.0 / (width(a).powi(2) + width(b).powi(2)));
        let target = self.ends[1].iter().copied().min_by(|&a, &b| cost[a].total_cmp(&cost[b])).unwrap_or(0);
        let mut way = vec![target];
        while let Some(before) = from[way[way.len() - 1]] {
            way.push(before);
        }
        way.reverse();
        way.into_iter().map(|r| void.grid.centre(void.cells[r])).collect()
    }
}

fn mean_of(void: &EnclosedVoid, ranks: &[usize]) -> Vec3 {
    ranks.iter().map(|&r| void.grid.centre(void.cells[r])).sum::<Vec3>() / ranks.len() as f64
}

/// Connected pieces of bands of equal distance, and which pieces of the band before each one touches.
struct LevelSets {
    pieces: Vec<Vec<usize>>,
    piece_of: Vec<usize>,
    band_of: Vec<usize>,
    /// Pieces of the band before, with the number of contacts.
    parents: Vec<BTreeMap<usize, usize>>,
}

fn level_sets(void: &EnclosedVoid, distance: &[f64], width: f64) -> LevelSets {
    let mut bands: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for (rank, d) in distance.iter().enumerate() {
        bands.entry((d / width) as usize).or_default().push(rank);
    }
    let mut sets =
        LevelSets { pieces: Vec::new(), piece_of: vec![0; distance.len()], band_of: Vec::new(), parents: Vec::new() };
    for (band, ranks) in bands {
        for group in groups(void, &ranks) {
            for &rank in &group {
                sets.piece_of[rank] = sets.pieces.len();
            }
            sets.pieces.push(group);
            sets.band_of.push(band);
        }
    }
    sets.parents = vec![BTreeMap::new(); sets.pieces.len()];
    for (rank, &cell) in void.cells.iter().enumerate() {
        let piece = sets.piece_of[rank];
        for (n, _) in void.grid.neighbours(cell, 26) {
            if let Ok(other) = void.cells.binary_search(&n) {
                let neighbour = sets.piece_of[other];
                if sets.band_of[neighbour] < sets.band_of[piece] {
                    *sets.parents[piece].entry(neighbour).or_default() += 1;
                }
            }
        }
    }
    sets
}

impl LevelSets {
    /// The parent with most contacts.
    fn parent(&self, piece: usize) -> Option<usize> {
        self.parents[piece].iter().max_by_key(|&(&p, &contacts)| (contacts, Reverse(p))).map(|(&p, _)| p)
    }

    /// Pieces from the start to `piece`.
    fn path_to(&self, piece: usize) -> Vec<usize> {
        let mut path = vec![piece];
        while let Some(before) = self.parent(path[path.len() - 1]) {
            path.push(before);
        }
        path.reverse();
        path
    }

    /// Side drifts of the main path, the longest loop's shorter arm, and the number of pillars.
    fn side_spaces(
        &self,
        main: &[usize],
        distance: &[f64],
        void: &EnclosedVoid,
        mean: impl Fn(&[usize]) -> Vec3,
        width: f64,
    ) -> (Vec<RoughBranch>, Option<f64>, usize) {
        let mut root = vec![usize::MAX; self.pieces.len()];
        main.iter().for_each(|&p| root[p] = p);
        let mut sides: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        let mut loop_arm_m: Option<f64> = None;
        let mut pillars = 0;
        // Pieces are numbered band by band, so a parent's root is known before its children ask.
        for piece in 0..self.pieces.len() {
            if root[piece] == usize::MAX {
                let Some(parent) = self.parent(piece) else { continue };
                root[piece] = if root[parent] == parent && main.contains(&parent) { piece } else { root[parent] };
                if root[piece] != usize::MAX {
                    sides.entry(root[piece]).or_default().push(piece);
                }
            }
            for &parent in self.parents[piece].keys() {
                if Some(parent) == self.parent(piece) {
                    continue;
                }
                let arm = self.cycle_arm(piece, parent) as f64 * width;
                if arm >= LOOP_CLEARANCES * void.clearance_m {
                    loop_arm_m = Some(loop_arm_m.unwrap_or(0.0).max(arm));
                } else {
                    pillars += 1;
                }
            }
        }
        let mut branches = Vec::new();
        for (first, pieces) in sides {
            let ranks: Vec<usize> = pieces.iter().flat_map(|&p| self.pieces[p].iter().copied()).collect();
            let near = ranks.iter().map(|&r| distance[r]).fold(f64::INFINITY, f64::min);
            let far = ranks.iter().map(|&r| distance[r]).fold(0.0, f64::max);
            if far - near >= BRANCH_CLEARANCES * void.clearance_m {
                branches.push(RoughBranch {
                    mouth: mean(&self.pieces[first]),
                    middle: mean(&ranks),
                    length_m: far - near,
                });
            }
        }
        (branches, loop_arm_m, pillars)
    }

    /// Bands from a merge back to where its two arms split, for the arm through `parent`.
    fn cycle_arm(&self, merge: usize, parent: usize) -> usize {
        let Some(other) = self.parent(merge) else { return 0 };
        let one = self.path_to(other);
        let two = self.path_to(parent);
        let common = one.iter().zip(&two).take_while(|(a, b)| a == b).count();
        (one.len() - common).min(two.len() - common)
    }
}
