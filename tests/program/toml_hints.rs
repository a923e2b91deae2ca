//! Hints in the errors of TOML that users write: scenarios, experiments, options and `testbed.toml`.

use reveille_tests::process::{TestFolder, assert_refused};

#[test]
fn every_toml_file_of_a_user_has_the_same_hints() {
    const WHOLE: &str = "use a whole number such as 10000";
    let folder = TestFolder::new();
    for (text, parts) in [
        ("ttis = 1e4", ["my.toml, line 1", WHOLE]),
        ("policy.name = two", ["my.toml, line 1", "put text in quotes"]),
        ("devces = 3", ["my.toml, line 1", "did you mean `devices`?"]),
    ] {
        folder.write("my.toml", text);
        let refused = folder.run("scenario check my.toml");
        assert_eq!(refused.code(), Some(1), "{refused}");
        for part in parts {
            assert!(refused.stderr.contains(part), "no {part:?}: {refused}");
        }
        assert_eq!(refused.stderr.matches("my.toml").count(), 1, "{refused}");
    }
    for (text, parts) in [
        ("min_seeds = 1e4", ["my.toml, line 1: min_seeds", WHOLE]),
        ("seeds = 1e4", ["my.toml, line 1", WHOLE]),
        ("scenario = two", ["my.toml, line 1", "put text in quotes"]),
        ("seds = 3", ["my.toml, line 1", "did you mean `seeds`?"]),
    ] {
        folder.write("my.toml", text);
        assert_refused(&folder.run("sweep my.toml"), 1, &parts);
    }
    assert_refused(&folder.run("sweep --grid devices=[1"), 1, &["--grid", "unclosed array"]);
    let testbed = folder.run("testbed init -n 5 -k 100 --out bed");
    assert!(testbed.is_success(), "{testbed}");
    let valid = String::from_utf8(folder.bytes("bed/testbed.toml")).expect("UTF-8");
    for (from, to, parts) in [
        (
            "name = \"bed\"",
            "name = two",
            ["bed/testbed.toml, line 4", "put text in quotes"],
        ),
        (
            "name = \"bed\"",
            "names = \"bed\"",
            ["bed/testbed.toml, line", "did you mean `name`?"],
        ),
        ("containers = 5", "containers = 1e4", ["bed/testbed.toml, line", WHOLE]),
    ] {
        folder.write("bed/testbed.toml", &valid.replacen(from, to, 1));
        assert_refused(&folder.run("testbed status bed"), 1, &parts);
    }
}
