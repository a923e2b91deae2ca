//! The variables of `docker-compose.yml`, with their defaults, agree with the table in `deploy/docker/README.md` and
//! with the names in `deploy/docker/testbed.env`.

use std::collections::BTreeMap;
use std::path::Path;

fn read(path: &str) -> String {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the repository");
    std::fs::read_to_string(root.join(path)).expect("a file of the repository")
}

/// Returns the variables that `text` expands, `${NAME:-default}` or `${NAME-default}`, with their defaults.
fn expanded_variables(text: &str) -> BTreeMap<&str, &str> {
    let expansions = text
        .split("${")
        .skip(1)
        .map(|rest| rest.split_once('}').expect("a closing brace").0);
    expansions
        .map(|expansion| {
            let (name, default) = expansion.split_once('-').expect("a default");
            (name.trim_end_matches(':'), default)
        })
        .collect()
}

#[test]
fn the_documented_variables_are_those_of_the_compose_file() {
    let compose = read("docker-compose.yml");
    let mut expected = expanded_variables(&compose);
    assert!(compose.contains("- RUST_LOG\n"), "passed on if it is set");
    expected.insert("RUST_LOG", "unset");
    for default in expected.values_mut().filter(|default| default.is_empty()) {
        *default = "empty";
    }
    let readme = read("deploy/docker/README.md");
    let table = readme
        .lines()
        .skip_while(|line| !line.starts_with("| Variable |"))
        .skip(2);
    let documented: BTreeMap<&str, &str> = table
        .take_while(|line| line.starts_with('|'))
        .map(|line| {
            let cells: Vec<&str> = line.split('|').map(str::trim).collect();
            (cells[1], cells[2].trim_matches('`'))
        })
        .collect();
    assert_eq!(documented, expected);
    let env_file = read("deploy/docker/testbed.env");
    for line in env_file.lines().filter(|line| line.contains('=')) {
        let name = line.trim_start_matches('#').split('=').next().expect("a name");
        assert!(expected.contains_key(name), "testbed.env: {line}");
    }
}
