//! The name and the address of a run on the bus: `address.json` in the run folder, so that clients that wait for a
//! killed run find the resumed run without further options. `up` and `bs` write it; a complete run has none.

use std::path::Path;

use anyhow::Context;
use reveille_common::bus;
use reveille_common::keys::RunName;
use reveille_lab::io::replace;
use serde::{Deserialize, Serialize};

/// The file name in a run folder.
pub(crate) const ADDRESS_FILE: &str = "address.json";

/// The name and the address of a run.
#[derive(Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct RunAddress {
    /// The name, if `--run` gave it.
    run: Option<String>,
    /// The endpoint of the base station.
    listen: Option<String>,
    /// Whether the port was a free one that `up` chose.
    has_chosen_port: bool,
}

impl RunAddress {
    /// Reads the address of the run that `resume` names; empty for a new run, or without a valid file.
    pub(crate) fn of_resumed(resume: Option<&Path>) -> Self {
        let text = resume.and_then(|folder| std::fs::read(folder.join(ADDRESS_FILE)).ok());
        text.and_then(|text| serde_json::from_slice(&text).ok())
            .unwrap_or_default()
    }

    /// Returns the name that the option `--run` or, for a resumed run, its folder gives.
    pub(crate) fn run(&self, option: Option<&RunName>) -> Option<RunName> {
        option.cloned().or_else(|| self.run.as_ref()?.parse().ok())
    }

    /// Returns the name as [`Self::run`] does; otherwise the one of the resumed `folder`.
    ///
    /// # Errors
    /// If there is no name and no folder.
    pub(crate) fn run_of_folder(&self, option: Option<&RunName>, folder: Option<&Path>) -> anyhow::Result<RunName> {
        match self.run(option) {
            Some(run) => Ok(run),
            None => Ok(run_name(folder.context("--run: the name of the run is missing")?).parse()?),
        }
    }

    /// Returns the address of `bs`: from its option, or the one of the resumed run unless `up` chose it.
    pub(crate) fn bs_listen<'a>(&'a self, option: Option<&'a str>, default: &'a str) -> &'a str {
        let given = self.listen.as_deref().filter(|_| !self.has_chosen_port);
        option.or(given).unwrap_or(default)
    }

    /// Returns the address of `up`: from its option, or the one of the resumed run if this machine has it free.
    pub(crate) fn up_listen<'a>(&'a self, option: Option<&'a str>, default: &'a str) -> &'a str {
        let Some(earlier) = self.listen.as_deref().filter(|_| option.is_none()) else {
            return option.unwrap_or(default);
        };
        match bus::resolve_listen_endpoint(earlier) {
            Ok(_) => earlier,
            Err(error) => {
                if !self.has_chosen_port {
                    tracing::warn!("{error}; listening at a free port instead; give another address with --listen");
                }
                default
            }
        }
    }

    /// Writes the address of a run into its `folder`: the name that an option or this address gives, and the endpoint,
    /// requested as `listen`.
    ///
    /// # Errors
    /// If the file cannot be written.
    pub(crate) fn write(
        &self,
        folder: &Path,
        run: Option<&RunName>,
        (listen, endpoint): (&str, &str),
    ) -> anyhow::Result<()> {
        let is_earlier = self.listen.as_deref() == Some(listen);
        let address = Self {
            run: self.run(run).map(|run| run.to_string()),
            listen: Some(endpoint.to_owned()),
            has_chosen_port: listen.ends_with(":0") || is_earlier && self.has_chosen_port,
        };
        let path = folder.join(ADDRESS_FILE);
        replace(&path, &serde_json::to_vec(&address)?).with_context(|| format!("cannot write {}", path.display()))
    }
}

/// Returns the last part of the path of a run folder, changed to a valid run name.
pub(crate) fn run_name(path: &Path) -> String {
    let name = path.file_name().unwrap_or_default().to_string_lossy();
    let to_name_char = |c: char| {
        if c.is_ascii_alphanumeric() || c == '-' || c == '_' {
            c
        } else {
            '-'
        }
    };
    // A run name (`RunName`) has at most 64 characters and does not begin with `-`.
    let name: String = name
        .chars()
        .map(to_name_char)
        .skip_while(|&c| c == '-')
        .take(64)
        .collect();
    if name.is_empty() { "run".to_owned() } else { name }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_option_goes_before_the_address_of_the_resumed_run() {
        let taken = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let taken = format!("tcp/{}", taken.local_addr().expect("bound"));
        let given = RunAddress {
            run: Some("field".to_owned()),
            listen: Some(taken.clone()),
            has_chosen_port: false,
        };
        let chosen = RunAddress {
            listen: Some(taken.clone()),
            has_chosen_port: true,
            ..RunAddress::default()
        };
        let (option, default) = (Some("tcp/127.0.0.1:9"), "tcp/127.0.0.1:0");
        assert_eq!(given.up_listen(option, default), "tcp/127.0.0.1:9");
        assert_eq!(given.bs_listen(option, default), "tcp/127.0.0.1:9");
        assert_eq!(given.bs_listen(None, default), taken);
        assert_eq!(chosen.bs_listen(None, default), default);
        assert_eq!(given.run(None).map(|run| run.to_string()).as_deref(), Some("field"));
        let option = "other".parse().ok();
        assert_eq!(given.run(option.as_ref()), option);
        assert_eq!(chosen.run(None), None);
    }

    #[test]
    fn an_address_in_use_is_replaced_by_a_free_port() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let address = RunAddress {
            listen: Some(format!("tcp/{}", listener.local_addr().expect("bound"))),
            ..RunAddress::default()
        };
        assert_eq!(address.up_listen(None, "tcp/127.0.0.1:0"), "tcp/127.0.0.1:0");
        drop(listener);
        assert_ne!(address.up_listen(None, "tcp/127.0.0.1:0"), "tcp/127.0.0.1:0");
    }

    #[test]
    fn an_address_is_read_back() {
        let folder = std::env::temp_dir().join(format!("reveille-address-{}", std::process::id()));
        std::fs::create_dir(&folder).expect("writable");
        let run = "field".parse().ok();
        let new = RunAddress::default();
        new.write(&folder, run.as_ref(), ("tcp/127.0.0.1:0", "tcp/127.0.0.1:40123"))
            .expect("writable");
        let read = RunAddress::of_resumed(Some(&folder));
        assert_eq!((read.run(None), read.has_chosen_port), (run, true));
        // A port that a resumed run keeps is still a chosen one.
        let endpoint = "tcp/127.0.0.1:40123";
        read.write(&folder, None, (endpoint, endpoint)).expect("writable");
        assert_eq!(RunAddress::of_resumed(Some(&folder)), read);
        std::fs::write(folder.join(ADDRESS_FILE), "{").expect("writable");
        assert_eq!(RunAddress::of_resumed(Some(&folder)), RunAddress::default());
        assert_eq!(RunAddress::of_resumed(None), RunAddress::default());
        std::fs::remove_dir_all(&folder).expect("ours");
    }
}
