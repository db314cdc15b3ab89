export * from "./models/pack.js"; export * from "./models/image.js"; export * from "./models/errors.js";
