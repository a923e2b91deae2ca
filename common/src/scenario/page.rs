//! A scenario written out.

use super::declaration::declaration;
use super::model::{Policies, Scenario};
use super::run::Run;
use crate::declare::Page;

impl Scenario {
    /// The complete scenario as TOML, with units. Loading it gives an equal scenario as long as the layout and trace
    /// files that it names are still there.
    #[must_use]
    pub fn to_toml(&self) -> String {
        self.page().in_force(&declaration(&[self.policy.kind()]))
    }

    /// As [`Self::to_toml`], with every field that does not count here commented out: those of other kinds and of other
    /// `policies`.
    #[must_use]
    pub fn to_full_toml(&self, policies: Policies<'_>) -> String {
        self.page().everything(&declaration(policies))
    }

    fn page(&self) -> Page {
        let mut page = Page::default();
        Run::visit_preset(&self.preset, &mut page);
        self.visit(&mut page);
        page
    }
}
