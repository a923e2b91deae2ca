//! Pages of docs/ that hold a table from the code.

use std::path::Path;

/// Protects: what stands between `<!-- NAME -->` and `<!-- /NAME -->` in `page` is the `table` that the code makes.
/// Writes it there if it is not.
pub fn assert_table(page: &str, name: &str, table: &str) {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("..").join(page);
    let [above, below] = [format!("<!-- {name} -->\n"), format!("<!-- /{name} -->")];
    let text = std::fs::read_to_string(&path).expect("the page");
    let (before, rest) = text.split_once(&above).expect("the mark above the table");
    let (held, after) = rest.split_once(&below).expect("the mark below the table");
    if held != table {
        let text = [before, &above, table, &below, after].concat();
        std::fs::write(&path, text).expect("writable");
        panic!("{page} was not current; it is now: commit it");
    }
}
