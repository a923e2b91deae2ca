//! The registry of runs on this machine, a folder below `XDG_RUNTIME_DIR`: its entries are private, and it is trusted
//! only if no other user can write to it. The tests repeat the name of the folder and the fields of an entry from
//! `deploy/src/run_registry.rs`.

use std::fs::{self, Permissions};
use std::os::unix::fs::{PermissionsExt, chown, symlink};

use reveille_tests::machine::print_skipped;
use reveille_tests::process::{PATIENCE, Process, TestFolder, assert_refused, free_endpoint, unique_run, wait_until};
use rustix::process::{Signal, getuid};

/// Folder of the registry entries, in the folder of a test.
const REGISTRY: &str = "runtime/reveille";
/// Id of the user `nobody`.
const NOBODY: u32 = 65_534;

/// Returns the permissions of an entry in the folder.
fn permissions_of(folder: &TestFolder, name: &str) -> u32 {
    let metadata = fs::symlink_metadata(folder.join(name)).expect("there");
    metadata.permissions().mode() & 0o777
}

#[test]
fn entries_are_private() {
    let (folder, run) = (TestFolder::new(), unique_run("own"));
    let mut command = std::process::Command::new("sh");
    let program = reveille_tests::process::reveille().display();
    let endpoint = free_endpoint();
    command
        .args([
            "-c",
            &format!("umask 0; exec {program} bs -n 30 --run {run} --listen {endpoint}"),
        ])
        .current_dir(folder.path())
        .env("XDG_RUNTIME_DIR", folder.join("runtime"));
    let bs = Process::start(&mut command);
    let entry = wait_until("the run to be registered", PATIENCE, || {
        folder.list(REGISTRY).first().cloned()
    });
    assert_eq!(permissions_of(&folder, REGISTRY), 0o700);
    assert_eq!(permissions_of(&folder, &format!("{REGISTRY}/{entry}")), 0o600);
    bs.wait_for_handlers();
    bs.signal(Signal::INT);
    assert_eq!(bs.finish().code(), Some(130));
}

#[test]
fn an_ended_base_station_is_reported_with_the_command_that_resumes_its_run() {
    let (folder, run) = (TestFolder::new(), unique_run("ended"));
    let scenario = "-P 1 -n 5 -k 200";
    let up = folder.start(&format!("up {scenario} --paused --quiet --run {run} --out out"));
    folder.wait_for_clock(&run);
    let entry_path = format!("{REGISTRY}/{}", folder.list(REGISTRY)[0]);
    let entry: serde_json::Value = serde_json::from_slice(&folder.bytes(&entry_path)).expect("JSON");
    let endpoint = entry["endpoint"].as_str().expect("an endpoint").to_owned();
    up.signal(Signal::KILL);
    // Without `finish`, which waits for the process, it stays a zombie.
    let hint = format!("reveille up --resume {}", folder.join("out").display());
    for command in [
        format!("clock status --run {run}"),
        "clock status".to_owned(),
        format!("clock resume --run {run} --connect {endpoint}"),
        "inspect tail".to_owned(),
    ] {
        let finished = wait_until("the end of the base station", PATIENCE, || {
            let finished = folder.run(&command);
            finished.stderr.contains("has ended").then_some(finished)
        });
        assert_refused(&finished, 1, &[&format!("run {run}: its base station"), &hint]);
    }
    // The pid has been given to another process since: this one.
    let mut of_reused_pid = entry.clone();
    of_reused_pid["pid"] = std::process::id().into();
    folder.write(&entry_path, &of_reused_pid.to_string());
    assert_refused(&folder.run("clock status"), 1, &["its base station", &hint]);
    folder.write(&entry_path, &entry.to_string());
    up.finish();
    let resumed = folder.run("up --resume out -P 1 --quiet");
    assert!(resumed.is_success(), "{resumed}");
    assert_refused(&folder.run("clock status"), 1, &["no run on this machine"]);
    assert!(
        folder.list(REGISTRY).is_empty(),
        "the entry of the killed process is removed"
    );
}

/// Checks that `clock` and `inspect` refuse the registry because of `why`, and that a run warns, continues and does not
/// write to it. If the registry is a folder, it holds a valid entry meanwhile.
fn assert_not_trusted(folder: &TestFolder, why: &str) {
    let (run, endpoint) = (unique_run("untrusted"), free_endpoint());
    // An entry of a live process: this one.
    let entry = format!(
        r#"{{"run":"{run}","endpoint":"{endpoint}","pid":{}}}"#,
        std::process::id()
    );
    let entry_path = format!("{REGISTRY}/{run}-1.json");
    let is_folder = folder.join(REGISTRY).is_dir();
    if is_folder {
        folder.write(&entry_path, &entry);
    }
    for command in ["clock status", "inspect tail --count 1"] {
        let finished = folder.run(&format!("{command} --run {run}"));
        assert_refused(&finished, 1, &[REGISTRY, why, "XDG_RUNTIME_DIR", "--connect"]);
    }
    let entries_before = folder.list(REGISTRY);
    let up = folder.run(&format!("up -P 1 -n 5 -k 100 --quiet --run {run} --out {run}"));
    assert!(up.is_success(), "{up}");
    for part in [REGISTRY, why, "cannot find this run"] {
        assert!(up.stderr.contains(part), "no {part:?}: {up}");
    }
    assert_eq!(folder.list(REGISTRY), entries_before);
    if is_folder {
        fs::remove_file(folder.join(&entry_path)).expect("ours");
    }
}

#[test]
fn a_registry_open_to_others_is_not_trusted() {
    let folder = TestFolder::new();
    fs::create_dir(folder.join(REGISTRY)).expect("possible");
    for permissions in [0o755, 0o770, 0o1777] {
        fs::set_permissions(folder.join(REGISTRY), Permissions::from_mode(permissions)).expect("ours");
        assert_not_trusted(&folder, "chmod 700");
    }
    fs::set_permissions(folder.join(REGISTRY), Permissions::from_mode(0o700)).expect("ours");
    let finished = folder.run("clock status");
    assert_refused(&finished, 1, &["no run on this machine"]);
}

#[test]
fn a_link_or_file_as_registry_is_not_trusted() {
    let folder = TestFolder::new();
    fs::create_dir(folder.join("elsewhere")).expect("possible");
    fs::set_permissions(folder.join("elsewhere"), Permissions::from_mode(0o700)).expect("ours");
    symlink(folder.join("elsewhere"), folder.join(REGISTRY)).expect("possible");
    assert_not_trusted(&folder, "a link or a file");
    fs::remove_file(folder.join(REGISTRY)).expect("ours");
    symlink(folder.join("nowhere"), folder.join(REGISTRY)).expect("possible");
    assert_not_trusted(&folder, "a link or a file");
    assert!(!folder.join("nowhere").exists());
    fs::remove_file(folder.join(REGISTRY)).expect("ours");
    folder.write(REGISTRY, "");
    assert_not_trusted(&folder, "a link or a file");
}

#[test]
fn a_registry_of_another_user_is_not_trusted() {
    if !getuid().is_root() {
        print_skipped("cannot give a folder to another user here (root is needed)");
        return;
    }
    let folder = TestFolder::new();
    fs::create_dir(folder.join(REGISTRY)).expect("possible");
    fs::set_permissions(folder.join(REGISTRY), Permissions::from_mode(0o700)).expect("ours");
    chown(folder.join(REGISTRY), Some(NOBODY), Some(NOBODY)).expect("root may");
    assert_not_trusted(&folder, "another user (65534, you are 0)");
}

#[test]
fn a_relative_runtime_folder_is_not_used() {
    let (folder, run) = (TestFolder::new(), unique_run("relative"));
    // The run uses the folder `reveille-UID` for temporary files instead.
    let mut command = folder.command(&format!("up -P 0 -n 5 -k 100 --quiet --run {run} --out out"));
    command.env("XDG_RUNTIME_DIR", "runtime").env("TMPDIR", folder.path());
    let finished = Process::start(&mut command).finish();
    assert!(finished.is_success(), "{finished}");
    assert!(!folder.join(REGISTRY).exists());
    assert_eq!(
        permissions_of(&folder, &format!("reveille-{}", getuid().as_raw())),
        0o700
    );
}
