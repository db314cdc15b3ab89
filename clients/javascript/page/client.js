// What the service's own page takes of this package.
export { base64url } from "../dist/bytes.js";
export { defineLogin } from "../dist/element/login.js";
export { isPhotoRefused } from "../dist/errors.js";
export { createPasskey, passkeyHolderKey, whyNoPasskey } from "../dist/service/passkey.js";
