//! Why claims should not be expected to hold as written, where the model says so.

/// On information of 0.72 with 250 devices.
pub const CLOSEST: &str = "Under g = max an event gives no more than its closest device reports. With 250 devices on \
    20 × 20 m that is 0.55 on the mean where they stand at random, 0.59 on a jittered grid, and 0.63 in the best of \
    all layouts, a lattice of regular hexagons.";
/// On the genie's 0.055 units.
pub const WUR_FLOOR: &str = "A device that always listens spends E_WuR = 1/14 = 0.0714 units in every TTI, so 0.055 \
    lies below what the genie's sleepers alone spend.";
/// On whatever adjusted's devices do too seldom here.
pub const SPARING: &str = "Of the duty cycles of its grid, adjusted takes the one that spends least among those that \
    reach I_min, which is next to nothing where devices are few, as p falls with the distance. The paper states \
    neither its grid nor the cycle it found; its devices must sense more often than that.";
/// On what random does as N rises.
pub const FIXED_CYCLE: &str = "The duty cycles of Sec. VI, t_on of 1 or 2 in t_DRX of 2, 4 or 8, have a device sense \
    in 0.44 of all TTIs on the mean, whatever N is: about 0.48 units where the harvest allows it. Nothing in them \
    falls with N.";
/// On the genie's 2 % with ten devices.
pub const REACH: &str = "Ten discs of d_max = 4 m do not cover 20 × 20 m however they are placed: that takes 4.36 m. \
    At random places they leave a third of the area out of reach, on a jittered grid a quarter, and an event there is \
    lost whoever is woken.";
/// On knn's misdetections with many devices.
pub const UNSEEN: &str = "One device of each cluster senses, a dozen or so, which leaves part of the area unwatched in \
    any one TTI.";
/// On spending more than there is to harvest.
pub const HARVEST: &str = "In the long run devices spend no more than they harvest, 0.45 units under Eq. (5) with λ = \
    0.1 and E_B = 5 as in the presets.";
/// On one event in 100 000.
pub const RARE: &str = "The genie's devices sleep until they are woken, so that their batteries are nearly full. It \
    takes some 400 000 events to tell one in 100 000 from none.";
