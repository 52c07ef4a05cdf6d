//! Tunnels whose axis, surface, labels, colours and map are known in closed form.
//!
//! A [`Tunnel`] is a [`Section`] swept along an [`Alignment`]. Its exact meshes and the points of a simulated
//! scanner carry their true section coordinates, so every later stage can be judged without a reference program.
//!
//! ```
//! use adit::synthetic::{Alignment, Section, ScanPlan, Tunnel, scan};
//! let tunnel = Tunnel::smooth(Section::horseshoe(4.6, 4.2), Alignment::bend(20.0, 40.0));
//! let strip = tunnel.strip(40, 60); // cut open along the invert; `strip.uv` is the exact map
//! assert_eq!(strip.mesh.faces().len(), 2 * 40 * 60);
//! let scan = scan(&tunnel, &ScanPlan { points: 20_000, ..ScanPlan::default() }).unwrap();
//! assert_eq!(scan.cloud.len(), scan.truth.girth_m.len());
//! ```

mod alignment;
mod fracture;
mod furniture;
mod lettering;
mod recess;
mod recipe;
mod relief;
mod rock;
mod scanner;
mod section;
mod tunnel;
mod view;

pub use alignment::{Alignment, Error as AlignmentError, Stretch};
pub use fracture::Fracture;
pub use furniture::Item;
pub use lettering::{Lettering, Wall};
pub use recess::Recess;
pub use recipe::{Course, Kind, Recipe, Shape};
pub use relief::{Noise, Relief};
pub use rock::Rock;
pub use scanner::{Error, ScanPlan, Surface, SyntheticScan, Truth, scan};
pub use section::{Foot, OutlinePoint, Section};
pub use tunnel::{KnownMesh, SectionPoint, Tunnel, WallPoint};
pub use view::{Part, View};
