// What the service's own page takes of this package.
export { FaceError, ImageError } from "../dist/models/errors.js";
export { VeilfaceError } from "../dist/errors.js";
export { ConnectionFailed, ContractMismatch, ServiceError } from "../dist/service/errors.js";
export { PrivateClient } from "../dist/service/private-client.js";
export { InconsistentImages } from "../dist/templates/errors.js";
