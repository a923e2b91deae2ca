//! How long ago each place was looked at.
//!
//! A place has an age: the TTIs in which an event may have started there and gone unnoticed, the coming one included.
//! Before the first TTI it is 1. A place that a device in S1 looks at is of age 1 in the next TTI, and so are all
//! places once an event has been found: it is closed, no other was on beside it, and the next can start in the next TTI
//! at the earliest. Any other place gets one TTI older.
//!
//! Where detection is sure within d_max, a look renews a place altogether. Where it is by chance, a look of a device at
//! distance d finds an event with probability p(d), and so renews the place with that probability: its age is then the
//! mean over looks that find and looks that do not. The same holds where the radio may lose what was found.

mod cells;
mod chance;
mod check;
pub mod choice;
pub mod foresight;
pub mod price;
pub mod staleness;
mod sure;
mod worths;

use reveille_common::geometry::{Area, Point};
use reveille_common::sensing::{DetectionKind, Sensing};

use self::cells::Cells;
use self::chance::Chance;
pub use self::check::{check, check_cells};
use self::sure::Sure;
pub use self::worths::{FREE, MOST, OLDEST, Worths, reach, worths};

/// The ages of the cells of an area, and what the devices that are chosen for the coming TTI leave to look at.
///
/// In each TTI devices are added, or removed again; [`Ages::pass`] then lets the TTI pass, in which they look.
#[derive(Clone, Debug)]
pub struct Ages {
    cells: Cells,
    looks: Looks,
}

#[derive(Clone, Debug)]
enum Looks {
    Sure(Sure),
    Chance(Chance),
}

impl Ages {
    /// Of `area` before the first TTI, with devices at `positions` and nobody chosen. An age is worth as much as
    /// `worths` says.
    pub fn new(positions: &[Point], area: Area, sensing: &Sensing, worths: Worths) -> Self {
        Self::losing(0.0, positions, area, sensing, worths)
    }

    /// As [`Self::new`], where nothing is heard of a device that has found something with probability `lost`,
    /// `[0, 1]`.
    pub fn losing(lost: f64, positions: &[Point], area: Area, sensing: &Sensing, worths: Worths) -> Self {
        let cells = Cells::new(area, sensing.d_max);
        let chance = |finds: &dyn Fn(f64) -> f64| {
            let heard = |d: f64| (1.0 - lost) * finds(d);
            Looks::Chance(Chance::new(&cells, positions, sensing.d_max, heard, worths))
        };
        let looks = match sensing.kind {
            DetectionKind::Range if lost <= 0.0 => Looks::Sure(Sure::new(&cells, positions, sensing.d_max, worths)),
            DetectionKind::Range => chance(&|_| 1.0),
            DetectionKind::Probabilistic => chance(&|d| sensing.p(d)),
        };
        Self { cells, looks }
    }

    /// What the `j`-th device would look at beside those chosen: the sum over its cells of the worths of their ages,
    /// where detection is by chance times the probability that the others find nothing there and it does.
    #[inline]
    pub fn worth(&self, j: usize) -> f64 {
        match &self.looks {
            Looks::Sure(sure) => f64::from(sure.worth(j)),
            Looks::Chance(chance) => chance.worth(j),
        }
    }

    /// What those chosen leave to look at: the sum over all cells, in the unit of [`Self::worth`].
    pub fn left(&self) -> f64 {
        match &self.looks {
            Looks::Sure(sure) => sure.left() as f64,
            Looks::Chance(chance) => chance.left(),
        }
    }

    /// The same if nobody was chosen.
    pub fn all(&self) -> f64 {
        match &self.looks {
            Looks::Sure(sure) => sure.all() as f64,
            Looks::Chance(chance) => chance.all(),
        }
    }

    /// Chooses the `j`-th device, which is not chosen.
    pub fn add(&mut self, j: usize) {
        match &mut self.looks {
            Looks::Sure(sure) => sure.add(j),
            Looks::Chance(chance) => chance.add(j),
        }
    }

    /// Takes the choice of the `j`-th device, which is chosen, back.
    pub fn remove(&mut self, j: usize) {
        match &mut self.looks {
            Looks::Sure(sure) => sure.remove(j),
            Looks::Chance(chance) => chance.remove(j),
        }
    }

    /// Takes all choices back.
    pub fn clear(&mut self) {
        match &mut self.looks {
            Looks::Sure(sure) => sure.clear(),
            Looks::Chance(chance) => chance.clear(),
        }
    }

    /// A TTI passes, in which those chosen look; nobody is chosen for the next. `is_found`: an event was reported.
    pub fn pass(&mut self, is_found: bool) {
        match &mut self.looks {
            Looks::Sure(sure) => sure.pass(is_found),
            Looks::Chance(chance) => chance.pass(is_found),
        }
    }

    /// The age of the place `at` in the coming TTI, TTIs, 1 ..= [`OLDEST`]. Outside of the area: that of the nearest
    /// cell.
    pub fn at(&self, at: Point) -> f64 {
        let cell = self.cells.cell(at);
        match &self.looks {
            Looks::Sure(sure) => f64::from(sure.age(cell)),
            Looks::Chance(chance) => chance.age(cell),
        }
    }

    /// The surface of a cell, m².
    pub fn cell_surface(&self) -> f64 {
        self.cells.surface()
    }
}

/// How many cells `area` has where devices sense as far as `d_max`.
pub fn cells(area: Area, d_max: f64) -> f64 {
    Cells::count(area, d_max)
}

#[cfg(test)]
mod tests;
