//! `up --on-loss continue`: a killed device process becomes a logged removal of its devices. The audit is complete, and
//! `run --input-log` reproduces the digest and tables, also after a resume. The paces make the runs long enough for the
//! kills, each some TTIs after the one before, and for resume marks, which are a second apart.

use reveille_tests::process::{PATIENCE, SummaryJson, TestFolder, hosts_of, send_signal, unique_run, wait_until};
use rustix::process::Signal;

#[test]
fn a_run_with_removed_devices_can_be_repeated() {
    let (folder, run) = (TestFolder::new(), unique_run("outage"));
    // With windows of one TTI, sums are requested in every TTI, and for some TTIs only part of them arrives.
    let scenario = "-n 24 -k 900 -p knn --window 1";
    let undisturbed = folder.summary(&format!("run {scenario}"));
    let up = folder.start(&format!(
        "up {scenario} -P 4 --pace 4ms --on-loss continue --audit on --out out --record out.mcap --run {run} --json"
    ));
    for remaining_hosts in [3, 2] {
        let tti = folder.wait_for_tti(&run, 10);
        let hosts = hosts_of(&run);
        send_signal(hosts[1], Signal::KILL);
        wait_until("the process to end", PATIENCE, || {
            (hosts_of(&run).len() == remaining_hosts).then_some(())
        });
        folder.wait_for_tti(&run, tti + 60);
    }
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    assert!(
        finished.stderr.contains("the run continues without its devices"),
        "{finished}"
    );
    let summary = finished.summary();
    assert_eq!((summary.status(), summary.text("audit")), ("complete", "complete"));
    assert_ne!(summary.digest(), undisturbed.digest());
    assert!(!finished.stdout.contains("\"removed_pct\": 0.0"), "{finished}");
    let read = |name: &str| String::from_utf8(folder.bytes(name)).expect("text");
    let log = read("out/inputs.log");
    assert_eq!(
        log.lines().filter(|line| line.contains("\"count\":6")).count(),
        2,
        "two removals of 24 / 4 devices: {log}"
    );

    let repeated = folder.summary(&format!("run {scenario} --input-log out/inputs.log --out repeated"));
    assert_eq!(repeated.digest(), summary.digest());
    assert_eq!(read("repeated/inputs.log"), log, "the input log of the repeated run");
    for table in ["events.csv", "devices.csv", "windows.csv"] {
        assert_eq!(
            read(&format!("repeated/{table}")),
            read(&format!("out/{table}")),
            "{table}"
        );
    }
    let verified = folder.run("inspect verify out.mcap");
    assert!(verified.is_success(), "{verified}");

    let other_seed = folder.run(&format!("run {scenario} --seed 2 --input-log out/inputs.log"));
    assert!(
        other_seed.code() == Some(1)
            && other_seed.stderr.contains("another scenario or seed")
            && other_seed.stderr.contains("leave out the other scenario options"),
        "{other_seed}"
    );
    std::fs::write(folder.join("invalid.log"), "no log\n").expect("writable");
    let invalid = folder.run(&format!("run {scenario} --input-log invalid.log"));
    assert!(
        invalid.code() == Some(1) && invalid.stderr.contains("line 1, column "),
        "{invalid}"
    );
}

#[test]
fn a_killed_run_with_removed_devices_resumes() {
    let (folder, run) = (TestFolder::new(), unique_run("outage"));
    let up = folder.start(&format!(
        "up -n 20 -k 1500 -p age-index -P 4 --pace 3ms --on-loss continue --out out --run {run}"
    ));
    folder.wait_for_tti(&run, 10);
    send_signal(hosts_of(&run)[0], Signal::KILL);
    wait_until("the log of the removal", PATIENCE, || {
        folder.list("out").contains(&"inputs.log".to_owned()).then_some(())
    });
    wait_until("a resume mark", PATIENCE, || {
        folder.list("out").contains(&"resume.json".to_owned()).then_some(())
    });
    up.signal(Signal::KILL);
    up.finish();
    // After a resume other hosts run the devices, and one of them is killed as well.
    let run = unique_run("outage");
    let up = folder.start(&format!(
        "up --resume out -P 2 --pace 3ms --on-loss continue --audit on --run {run}"
    ));
    let tti = folder.wait_for_tti(&run, 10);
    send_signal(hosts_of(&run)[0], Signal::KILL);
    wait_until("the process to end", PATIENCE, || {
        (hosts_of(&run).len() == 1).then_some(())
    });
    folder.wait_for_tti(&run, tti + 60);
    let finished = up.finish();
    assert!(finished.is_success(), "{finished}");
    let summary = SummaryJson::read(&folder.join("out"));
    let repeated = folder.summary("run -n 20 -k 1500 -p age-index --input-log out/inputs.log");
    assert_eq!((summary.digest(), summary.status()), (repeated.digest(), "complete"));
    let removed_pct = summary.metric("removed_pct");
    assert!(removed_pct > 0.0 && removed_pct < 100.0, "{removed_pct} %");
}
