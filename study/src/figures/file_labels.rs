//! Names of the conditions of result tables in the names of files. Scripts of users read these names.

use super::results::{Results, RunCondition};
use super::to_file_name;

impl RunCondition {
    /// Returns a part of a file name that describes the condition. If only the table identifies it and `has_folder` is
    /// set, the label includes the table's folder.
    fn file_label(&self, has_folder: bool) -> String {
        let mut label = self.preset.clone();
        for (path, value) in self.all_changes() {
            label = format!("{label}-{path}-{value}");
        }
        let action_table = self.actions.as_ref().map(|actions| &actions.table);
        if let Some(table) = self.changed_in_table.as_ref().or(action_table) {
            let table = std::path::Path::new(table);
            let folder = table
                .parent()
                .and_then(std::path::Path::file_name)
                .filter(|_| has_folder);
            for part in [folder, table.file_stem()].into_iter().flatten() {
                label = format!("{label}-{}", part.to_string_lossy());
            }
        }
        to_file_name(&label)
    }
}

impl Results {
    /// Unique part of a file name for each of [`Self::conditions`]. The files of `reveille figures TABLE` have it in
    /// their names.
    pub fn file_labels(&self) -> Vec<String> {
        let has_several_lengths = self.conditions.windows(2).any(|pair| pair[0].ttis != pair[1].ttis);
        let label_of = |condition: &RunCondition, has_folder: bool| {
            let label = condition.file_label(has_folder);
            if has_several_lengths {
                format!("{label}-k{}", condition.ttis)
            } else {
                label
            }
        };
        let without_folder: Vec<String> = self.conditions.iter().map(|c| label_of(c, false)).collect();
        let mut labels: Vec<String> = Vec::new();
        for (condition, label) in self.conditions.iter().zip(&without_folder) {
            // Some file systems ignore the case of names.
            let is_shared = without_folder
                .iter()
                .filter(|other| other.eq_ignore_ascii_case(label))
                .count()
                > 1;
            let label = label_of(condition, is_shared);
            let is_taken = |name: &str| labels.iter().any(|other| other.eq_ignore_ascii_case(name));
            let numbered = (2..).map(|i| format!("{label}-{i}"));
            let unique = std::iter::once(label.clone())
                .chain(numbered)
                .find(|name| !is_taken(name));
            labels.extend(unique);
        }
        labels
    }
}
