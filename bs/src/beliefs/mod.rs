//! Models that policies share, computed from [`Knowledge`](crate::knowledge::Knowledge) and observations, never from
//! ground truth.
//!
//! For the plan: [`ages`] of cells with the choice of sensing devices, [`coverage`] of the area, and [`clusters`] of
//! devices. For wake-ups: [`candidates`], ordered by [`ranking`] (`P_4,2` from [`correlation`]) or by the belief over
//! the epicentre in [`posterior`], and `information_target`, which wakes them until I_min. Ages and coverage count on
//! the cells of `grid`; `neighbours` lists devices by distance for the ranking. Decisions, and so digests, depend on
//! these results to the last bit. [`reward`] has the paper's rewards, which decide nothing in a run.

pub mod ages;
pub mod candidates;
pub mod clusters;
pub mod correlation;
pub mod coverage;
pub(crate) mod grid;
pub(crate) mod information_target;
mod neighbours;
pub mod posterior;
pub mod ranking;
pub mod reward;
