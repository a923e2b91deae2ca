//! The learners behind the `q-learning` policy (Sec. V-B), without I/O. `docs/q-learning.md` has the whole story.
//!
//! # Factorisation
//! A joint action δ(k) of N devices has 2^N values. Devices are therefore considered one after the other, and each has its
//! own share of the paper's reward.
//!
//! A place is covered in TTI k if some device that detects an event there senses in k or did in one of the `window` − 1 TTIs
//! before it: an event that ends there in k is then reported. With U(k) for the share of the area that is not covered, the
//! expectation of the paper's 1_0(I_i) is U(k), and
//!
//! ```text
//!   r(k)   = (1 − δ(k)·1/N) − α μ1 U(k)
//!   r_j(k) = (1 − δ_j(k))/N + α μ1 (c_j(k) − 1/N)
//! ```
//!
//! where c_j(k) is the share of the area whose first coverer in the window is device j: earlier TTIs come first, and within a
//! TTI those who were chosen earlier. Every covered place has one first coverer, so Σ_j c_j = 1 − U, and
//! Σ_j r_j = (1 − δ·1/N) + α μ1 (1 − U − 1) = r. A choice adds to c_j in its own TTI what it newly covers, and keeps that
//! for the whole window; so the table's target for δ_j = 1 has N α μ1 · (newly covered share) · (1 + ζ + … + ζ^(window − 1)).
//! With `window` = 1 that is N times the share's α μ1 c_j. With a longer one it is the part that is certain when the choice
//! is made: a place that somebody else had covered earlier falls to j as well once that has run out, and is left out.
//!
//! Wake-ups are decided one after the other too: the m-th of a TTI has the share μ2 (Î_m − Î_{m−1}) − 1/N. These telescope to
//! r*(k) = μ2 I_i − δ*·1/N, but for μ2 Î_0, the information that came without a wake-up.
//!
//! Tables hold N times these shares, and leave out α μ1, the part that is the same whatever a device does.

pub mod belief;
pub mod coverage;
pub mod duty;
pub mod wake;
