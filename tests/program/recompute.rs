//! Recomputes the metrics from the tables of the run folder with a program in another language.

use std::path::Path;
use std::process::Command;

use reveille_tests::machine::missing;
use reveille_tests::process::TestFolder;

/// Returns the recomputed scenarios: all policies, depleted devices, device classes, and very few events.
fn runs() -> Vec<String> {
    let policies = reveille_bs::policy::registry::names();
    let plain = policies.map(|policy| format!("-p {policy} -n 30 -k 1500"));
    let special = [
        "-s paper-literal -p knn -n 40 -k 1500 --set harvest.e_b=1",
        "-p adjusted -n 12 -k 900 --set energy.initial=0 --set policy.adjusted.pilot_ttis=400",
        "-p knn -n 20 -k 1200 --set energy.e_tx=45 --set bs.ranking=posterior",
        "-p knn -n 10 -k 300 --set events.alpha=0.0005",
        "-p knn -n 25 -k 1500 --set events.process=bursts --set events.duration_kind=geometric",
        "-p random -n 7 -k 400 --set warm_up=0",
    ];
    plain.chain(special.map(str::to_owned)).collect()
}

#[test]
fn metrics_follow_from_the_tables() {
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("../tests/recompute/recompute.py");
    let has_python = Command::new("python3").args(["-c", "import tomllib"]).status();
    if !has_python.is_ok_and(|status| status.success()) {
        return missing("metrics are not recomputed: python3 3.11 or later is missing");
    }
    let folder = TestFolder::new();
    let runs = runs();
    let mut check = Command::new("python3");
    check.arg(script);
    for (number, args) in runs.iter().enumerate() {
        let end = folder.run(&format!("run {args} --quiet --out run{number}"));
        assert!(end.is_success(), "{args}: {end}");
        check.arg(folder.join(&format!("run{number}")));
    }
    let told = check.output().expect("python3 starts");
    let text = String::from_utf8_lossy(&told.stdout);
    let complaint = String::from_utf8_lossy(&told.stderr);
    assert!(told.status.success(), "{text}\n{complaint}");
    assert_eq!(text.matches("metrics are the same").count(), runs.len(), "{text}");
}
