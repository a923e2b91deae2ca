// Sizes of canvases, and whether they are on the screen. Reading them from the layout in every paint would be slow.

const known = new WeakMap();

const sizes = new ResizeObserver((entries) => {
  for (const { target, contentRect: { width, height } } of entries) {
    const state = stateOf(target), hasChanged = state.width !== width || state.height !== height;
    Object.assign(state, { width, height });
    if (hasChanged && state.isVisible) state.onAppear?.();
  }
});
const places = new IntersectionObserver((entries) => {
  for (const { target, isIntersecting } of entries) {
    const state = stateOf(target), hasAppeared = isIntersecting && !state.isVisible;
    state.isVisible = isIntersecting;
    if (hasAppeared) state.onAppear?.();
  }
}, { rootMargin: "80px" });

function stateOf(element) {
  if (!known.has(element)) {
    known.set(element, { width: element.clientWidth, height: element.clientHeight, isVisible: true });
    sizes.observe(element);
    places.observe(element);
  }
  return known.get(element);
}

export const sizeOf = (element) => stateOf(element);
export const isVisible = (element) => stateOf(element).isVisible;

// Calls `act` when the element comes onto the screen, and when its size has changed there.
export function onAppear(element, act) {
  stateOf(element).onAppear = act;
}
