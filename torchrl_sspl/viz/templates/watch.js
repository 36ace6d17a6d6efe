const kept=300,events=[],style=name=>getComputedStyle(document.documentElement).getPropertyValue(name).trim();
let waiting=false;
const number=(x,d=3)=>x===null||x===undefined?"-":(x<0?"\u2212":"")+Math.abs(x).toFixed(d);
const share=(n,of)=>n.toLocaleString("en")+(of?" ("+(100*n/of).toFixed(1)+" %)":"");
function show(){
  waiting=false;const e=events[events.length-1];if(!e)return;
  byId("label").textContent=e.label;byId("why").textContent=e.why;
  byId("verdict").style.setProperty("--shown","var(--"+e.verdict+")");
  byId("step").textContent=e.step.toLocaleString("en")+", "+e.episode;
  byId("barrier").textContent=number(e.barrier);
  byId("wanted").textContent=e.wanted.map(x=>number(x,2)).join(", ");byId("taken").textContent=e.taken.map(x=>number(x,2)).join(", ");
  byId("interventions").textContent=e.protected?share(e.interventions,e.step):"no filter";
  byId("alarms").textContent=share(e.alarms,e.step);byId("entered").textContent=e.unsafe===null?"not known":e.entered;
  draw();
}
function draw(){
  const canvas=byId("curve"),ratio=devicePixelRatio||1,w=canvas.clientWidth,h=canvas.clientHeight,c=canvas.getContext("2d");
  canvas.width=w*ratio;canvas.height=h*ratio;c.setTransform(ratio,0,0,ratio,0,0);
  const values=events.map(e=>e.barrier).filter(x=>x!==null);let low=Math.min(-.1,...values),high=Math.max(.1,...values);
  const room=.06*(high-low),left=46,right=w-6,top=6,bottom=h-22;low-=room;high+=room;
  const x=k=>left+(right-left)*k/(kept-1),y=v=>bottom-(bottom-top)*(v-low)/(high-low);
  c.fillStyle=style("--good-bg");c.fillRect(left,y(0),right-left,bottom-y(0));
  c.font="12px system-ui,sans-serif";c.fillStyle=style("--soft");c.textAlign="right";c.textBaseline="middle";
  const step=[.05,.1,.2,.5,1,2,5].find(s=>(high-low)/s<=6)||10;
  c.strokeStyle=style("--line");c.lineWidth=1;
  for(let v=Math.ceil(low/step)*step;v<=high;v+=step){const r=Math.round(v/step)*step;c.fillText(number(r,step<.1?2:1),left-6,y(r));
    c.beginPath();c.moveTo(left,y(r));c.lineTo(right,y(r));c.stroke()}
  c.strokeStyle=style("--ink");c.lineWidth=1.5;c.beginPath();c.moveTo(left,y(0));c.lineTo(right,y(0));c.stroke();
  const wide=Math.max(1.5,(right-left)/kept);
  events.forEach((e,k)=>{
    if(e.begins){c.strokeStyle=style("--soft");c.lineWidth=1;c.setLineDash([3,4]);c.beginPath();c.moveTo(x(k),top);c.lineTo(x(k),bottom);c.stroke();c.setLineDash([])}
    if(e.intervened){c.fillStyle=style("--mark");c.fillRect(x(k)-wide/2,bottom+3,wide,7)}
    if(e.alarm){c.fillStyle=style("--UNKNOWN_PICTURE");c.fillRect(x(k)-wide/2,bottom+12,wide,7)}
  });
  c.strokeStyle=style("--curve");c.lineWidth=2;c.lineJoin="round";c.beginPath();let on=false;
  events.forEach((e,k)=>{if(e.barrier===null){on=false;return}if(!on||e.begins){c.moveTo(x(k),y(e.barrier));on=true}else c.lineTo(x(k),y(e.barrier))});
  c.stroke();
}
connect(()=>{events.length=0},e=>{if(e.picture)byId("picture").src=e.picture;events.push(e);if(events.length>kept)events.shift();
  if(!waiting){waiting=true;requestAnimationFrame(show)}});
addEventListener("resize",draw);matchMedia("(prefers-color-scheme:dark)").addEventListener("change",draw);
