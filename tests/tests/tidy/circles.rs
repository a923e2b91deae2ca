//! Circles in a graph of names.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

/// Who uses whom.
pub type Graph = BTreeMap<String, BTreeSet<String>>;

/// Every name that can be reached from itself, with a shortest way there: `a → b → a`.
pub fn circles(graph: &Graph) -> BTreeMap<String, String> {
    let with_way = |name: &String| way_back(graph, name).map(|way| (name.clone(), way.join(" → ")));
    graph.keys().filter_map(with_way).collect()
}

fn way_back(graph: &Graph, start: &str) -> Option<Vec<String>> {
    let mut reached_from: BTreeMap<&str, &str> = BTreeMap::new();
    let mut waiting = VecDeque::from([start]);
    while let Some(at) = waiting.pop_front() {
        for next in graph.get(at).into_iter().flatten() {
            if next == start {
                let mut way = vec![start.to_owned(), at.to_owned()];
                let mut step = at;
                while step != start {
                    step = reached_from[step];
                    way.push(step.to_owned());
                }
                way.reverse();
                return Some(way);
            }
            if !reached_from.contains_key(next.as_str()) {
                reached_from.insert(next, at);
                waiting.push_back(next);
            }
        }
    }
    None
}
