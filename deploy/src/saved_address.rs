//! The name, the address and the identity of a run on the bus: `address.json` in the run folder, so that clients that
//! wait for a killed run find the resumed run without further options. `up` and `bs` write it; a complete run has none.

use std::io;
use std::path::Path;

use anyhow::Context;
use reveille_common::bus;
use reveille_common::keys::RunName;
use reveille_lab::io::replace;
use serde::{Deserialize, Serialize};

/// The file name in a run folder.
pub(crate) const ADDRESS_FILE: &str = "address.json";

/// The name, the address and the identity of a run.
#[derive(Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default)]
pub(crate) struct SavedAddress {
    /// The name, if `--run` gave it.
    run: Option<String>,
    /// The endpoint of the base station.
    listen: Option<String>,
    /// Whether the port was any free one.
    has_free_port: bool,
    /// The identity of the run; `None` in files of earlier versions.
    id: Option<u64>,
}

impl SavedAddress {
    /// Reads the address of the run that `resume` names; empty for a new run. Without a valid file it is empty too, and
    /// a warning names the cause.
    pub(crate) fn of_resumed(resume: Option<&Path>) -> Self {
        let Some(path) = resume.map(|folder| folder.join(ADDRESS_FILE)) else {
            return Self::default();
        };
        let address = match std::fs::read(&path) {
            Ok(text) => serde_json::from_slice(&text).map_err(io::Error::from),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(Self::default()),
            Err(error) => Err(error),
        };
        address.unwrap_or_else(|error| {
            tracing::warn!(
                "{}: {error}; resuming with the default name and address, unless --run and --listen give others",
                path.display()
            );
            Self::default()
        })
    }

    /// Returns the name that the option `--run` or, for a resumed run, this address gives; otherwise the name of the
    /// run `folder`.
    ///
    /// # Errors
    /// If that is not a valid name.
    pub(crate) fn run_in(&self, option: Option<&RunName>, folder: &Path) -> anyhow::Result<RunName> {
        match self.run(option) {
            Some(run) => Ok(run),
            None => run_name(folder).parse().context("the run folder's name"),
        }
    }

    fn run(&self, option: Option<&RunName>) -> Option<RunName> {
        option.cloned().or_else(|| self.run.as_ref()?.parse().ok())
    }

    /// Returns the endpoint to listen at: from its option, or the earlier one. `default` replaces an earlier endpoint
    /// that is not free, if its port was a free one or `may_move`.
    pub(crate) fn listen<'a>(&'a self, option: Option<&'a str>, default: &'a str, may_move: bool) -> &'a str {
        let Some(earlier) = self.listen.as_deref().filter(|_| option.is_none()) else {
            return option.unwrap_or(default);
        };
        if !may_move && !self.has_free_port {
            return earlier;
        }
        match bus::resolve_listen_endpoint(earlier) {
            Ok(_) => earlier,
            Err(error) => {
                if !self.has_free_port {
                    tracing::warn!("{error}; listening at a free port instead; give another address with --listen");
                }
                default
            }
        }
    }

    /// Writes the address of a run into its `folder`: the name that an option or this address gives, and the endpoint,
    /// requested as `listen`. Returns the identity of the run, which is new unless this address has one.
    ///
    /// # Errors
    /// If the file cannot be written, or the operating system provides no randomness.
    pub(crate) fn write(
        &self,
        folder: &Path,
        run: Option<&RunName>,
        (listen, endpoint): (&str, &str),
    ) -> anyhow::Result<u64> {
        let id = self.id.map_or_else(bus::draw_nonce, Ok)?;
        let is_earlier = self.listen.as_deref() == Some(listen);
        let address = Self {
            run: self.run(run).map(|run| run.to_string()),
            listen: Some(endpoint.to_owned()),
            has_free_port: listen.ends_with(":0") || is_earlier && self.has_free_port,
            id: Some(id),
        };
        let path = folder.join(ADDRESS_FILE);
        replace(&path, &serde_json::to_vec(&address)?).with_context(|| format!("cannot write {}", path.display()))?;
        Ok(id)
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
    use reveille_tests::process::TestFolder;

    use super::*;

    #[test]
    fn an_option_goes_before_the_address_of_the_resumed_run() {
        let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a free port");
        let endpoint = format!("tcp/{}", listener.local_addr().expect("bound"));
        let given = SavedAddress {
            run: Some("field".to_owned()),
            listen: Some(endpoint.clone()),
            has_free_port: false,
            id: None,
        };
        let chosen = SavedAddress {
            listen: Some(endpoint.clone()),
            has_free_port: true,
            ..SavedAddress::default()
        };
        let (option, default) = (Some("tcp/127.0.0.1:9"), "tcp/127.0.0.1:0");
        for may_move in [true, false] {
            assert_eq!(given.listen(option, default, may_move), "tcp/127.0.0.1:9");
            assert_eq!(chosen.listen(None, default, may_move), default, "not free");
        }
        assert_eq!(given.listen(None, default, false), endpoint);
        assert_eq!(given.listen(None, default, true), default, "not free");
        assert_eq!(given.run(None).map(|run| run.to_string()).as_deref(), Some("field"));
        let option = "other".parse().ok();
        assert_eq!(given.run(option.as_ref()), option);
        assert_eq!(chosen.run(None), None);
    }

    #[test]
    fn an_address_is_read_back() {
        let test_folder = TestFolder::new();
        let folder = test_folder.join("run");
        std::fs::create_dir(&folder).expect("writable");
        let run = "field".parse().ok();
        let new = SavedAddress::default();
        let id = new
            .write(&folder, run.as_ref(), ("tcp/127.0.0.1:0", "tcp/127.0.0.1:40123"))
            .expect("writable");
        let read = SavedAddress::of_resumed(Some(&folder));
        assert_eq!((read.run(None), read.has_free_port), (run, true));
        // A port that a resumed run keeps is still a chosen one.
        let endpoint = "tcp/127.0.0.1:40123";
        let resumed_id = read.write(&folder, None, (endpoint, endpoint)).expect("writable");
        assert_eq!(resumed_id, id);
        assert_eq!(SavedAddress::of_resumed(Some(&folder)), read);
        let other_id = new.write(&folder, None, (endpoint, endpoint)).expect("writable");
        assert_ne!(other_id, id, "another run in the same folder");
        std::fs::write(folder.join(ADDRESS_FILE), "{").expect("writable");
        assert_eq!(SavedAddress::of_resumed(Some(&folder)), SavedAddress::default());
        assert_eq!(SavedAddress::of_resumed(None), SavedAddress::default());
        assert_eq!(
            SavedAddress::of_resumed(Some(&test_folder.join("none"))),
            SavedAddress::default()
        );
    }
}
