/** How `<veilface-login>` looks. It follows the `color-scheme` of the page that it is in. */

/**
 * What the person sees: the camera is off; a face is searched for; one is there that will do; photos
 * are taken or judged; and how it ended.
 */
export type State = "off" | "searching" | "ready" | "busy" | "accepted" | "rejected" | "failed";

// Properties have names of their own: a page may set ours by an `--accent` of its own.
export const STYLE = `
:host {
  --_surface: var(--veilface-surface, light-dark(#fff, #182026));
  --_text: var(--veilface-text, light-dark(#17212b, #e7edf1));
  --_muted: var(--veilface-muted, light-dark(#4a5764, #abb7c0));
  --_line: var(--veilface-line, light-dark(#d3dade, #35414b));
  --_accent: var(--veilface-accent, light-dark(#0b5563, #7cc9d6));
  --_on-accent: var(--veilface-on-accent, light-dark(#fff, #06262c));
  --_good: var(--veilface-good, light-dark(#0b6239, #7fd6a4));
  --_bad: var(--veilface-bad, light-dark(#9b1c1c, #ff9d94));
  --_radius: var(--veilface-radius, 1rem);
  display: block; width: 100%; max-width: var(--veilface-width, 22rem); color: var(--_text);
  font-family: var(--veilface-font, system-ui, -apple-system, "Segoe UI", Roboto, sans-serif);
  font-size: 1rem; line-height: 1.4; text-align: center;
}
:host([hidden]), [hidden] { display: none; }
*, ::before, ::after { box-sizing: border-box; }
.card {
  display: grid; gap: 0.9rem; padding: 1rem; background: var(--_surface);
  border: 1px solid var(--_line); border-radius: var(--_radius); box-shadow: 0 6px 24px rgb(0 0 0 / 0.1);
}
.viewfinder {
  --outline: var(--_muted); --tint: color-mix(in srgb, var(--_muted) 12%, var(--_surface));
  --figure: color-mix(in srgb, var(--_muted) 28%, var(--_surface));
  position: relative; display: grid; place-items: center; aspect-ratio: 6 / 7; overflow: hidden;
  border-radius: calc(var(--_radius) * 0.7);
  background:
    radial-gradient(ellipse 25% 30% at 50% 46%, var(--figure) 98%, transparent),
    radial-gradient(ellipse 47% 20% at 50% 101%, var(--figure) 98%, transparent), var(--tint);
}
video {
  position: absolute; inset: 0; width: 100%; height: 100%; object-fit: cover; transform: scaleX(-1);
}
.viewfinder::after {
  content: ""; position: absolute; inset: 10% 19% 14%; border: 3px dashed var(--outline);
  border-radius: 50%; transition: border-color 0.2s;
}
.on .viewfinder { --outline: #fff; background: #000; }
.on .viewfinder::after { box-shadow: 0 0 0 100vmax rgb(0 0 0 / 0.45); }
.ready .viewfinder, .busy .viewfinder { --outline: #58d68d; }
.ready .viewfinder::after, .busy .viewfinder::after { border-style: solid; border-width: 4px; }
.accepted .viewfinder, .rejected .viewfinder {
  --tone: var(--_bad); background: color-mix(in srgb, var(--tone) 14%, var(--_surface));
}
.accepted .viewfinder { --tone: var(--_good); }
.accepted .viewfinder::after, .rejected .viewfinder::after { display: none; }
.accepted .viewfinder::before, .rejected .viewfinder::before {
  content: "✕" / ""; display: grid; place-items: center; width: 6.5rem; height: 6.5rem; border-radius: 50%;
  background: var(--tone); color: var(--_surface); font-size: 3.25rem; line-height: 1; font-weight: 700;
}
.accepted .viewfinder::before { content: "✓" / ""; }
.status { display: grid; place-items: center; min-height: 2.8em; font-weight: 600; text-wrap: balance; }
.off .status:empty { min-height: 0; }
.accepted .status { color: var(--_good); }
.rejected .status, .failed .status { color: var(--_bad); }
button {
  font: inherit; font-weight: 600; min-height: 3rem; padding: 0.5rem 1.25rem; cursor: pointer;
  border: 0; border-radius: calc(var(--_radius) * 0.6); background: var(--_accent); color: var(--_on-accent);
}
button:hover:enabled { filter: brightness(1.08); }
button:focus-visible { outline: 3px solid var(--_accent); outline-offset: 3px; }
button:disabled { cursor: progress; opacity: 0.55; }
@media (max-height: 38rem) { .viewfinder { aspect-ratio: 1; } }
@media (prefers-reduced-motion: no-preference) {
  .busy .viewfinder::after { animation: breathe 1.1s ease-in-out infinite alternate; }
  .accepted .viewfinder::before, .rejected .viewfinder::before { animation: arrive 0.25s ease-out; }
}
@keyframes breathe { to { border-color: rgb(255 255 255 / 0.35); } }
@keyframes arrive { from { transform: scale(0.6); opacity: 0; } }
@media (forced-colors: active) { .card, button { border: 1px solid; } }
`;
